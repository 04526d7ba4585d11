"""When the values of a poll were taken: between request and answer, where the drive's own motion says."""

from __future__ import annotations

import numpy as np

from drivers.polling.when import SampleTimes


def test_the_motion_tells_the_time_that_the_host_does_not() -> None:
    """Delays of up to 4 ms before and after the drive takes its values, at 200 Hz."""
    rng = np.random.default_rng(3)
    n = 4000
    true_s = np.cumsum(0.005 + rng.exponential(0.001, n))
    late = rng.random(n) < 0.4
    sent_s = true_s - np.where(late, rng.uniform(0, 4e-3, n), 1e-4)
    received_s = true_s + np.where(late, rng.uniform(0, 4e-3, n), 1e-4)
    speed = 60.0 * np.sin(2 * np.pi * 0.4 * true_s) + 20.0 * np.sin(2 * np.pi * 1.3 * true_s)
    angle = -60.0 / (2 * np.pi * 0.4) * np.cos(2 * np.pi * 0.4 * true_s)
    angle += -20.0 / (2 * np.pi * 1.3) * np.cos(2 * np.pi * 1.3 * true_s)
    found = SampleTimes().times(sent_s, received_s, angle, speed)
    error, plain = found - true_s, sent_s - true_s
    assert (np.diff(found) > 0).all()
    assert (found <= received_s + 1e-12)[1:].all()
    assert error.std() < 0.25 * plain.std()


def test_without_a_speed_the_request_is_the_time() -> None:
    sent_s = np.arange(1, 100) * 0.005
    found = SampleTimes().times(sent_s, sent_s + 0.001, np.zeros(99), None)
    np.testing.assert_allclose(found, sent_s, atol=1e-12)


def test_times_rise_whatever_comes() -> None:
    rng = np.random.default_rng(4)
    sent_s = np.cumsum(rng.exponential(0.002, 2000))
    received_s = sent_s + rng.exponential(0.05, 2000)
    angle, speed = rng.normal(0, 100, 2000), rng.normal(0, 100, 2000)
    assert (np.diff(SampleTimes().times(sent_s, received_s, angle, speed)) > 0).all()
