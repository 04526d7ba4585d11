"""How samples are laid out for the filter; what a standing encoder is worth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from servo_daemon.conditioning.layout import Layout, channel
from servo_daemon.kalman.layout import SPIKE
from servo_daemon.samples import Quality, make_block

LSB = 1e-3


def rows_of(counts: Sequence[int] | np.ndarray, cuts: tuple[int, ...] = ()) -> np.ndarray:
    """The filter's rows for these counts, delivered in blocks cut there."""
    layout = Layout("voltage", ("current_A", "position_rad"))
    layout.expect_steps(LSB, 0.0)
    n = len(counts)
    t, zero = np.arange(n) * 1e-3, np.zeros(n)
    block = make_block(t, voltage_V=zero, current_A=zero, position_rad=LSB * np.array(counts))
    parts = [block.slice(a, b) for a, b in zip([0, *cuts], [*cuts, n], strict=True)]
    return np.concatenate([layout.rows(part, 0.0) for part in parts])


def doubts(counts: list[int], cuts: tuple[int, ...] = ()) -> np.ndarray:
    """Factors on the encoder's variance."""
    return np.asarray(rows_of(counts, cuts)[:, 9])


def test_what_no_drive_measures_is_no_measurement() -> None:
    """Squares of it overflow: that is no warning either."""
    voltage = np.array([1.0, 1e300, -1e300, np.nan, -2.0])
    values, valid = channel(make_block(np.arange(5) * 1e-3, voltage_V=voltage), "voltage_V")
    np.testing.assert_array_equal(values, [1.0, 0.0, 0.0, 0.0, -2.0])
    assert valid is not None
    np.testing.assert_array_equal(valid, [True, False, False, False, True])
    assert channel(make_block(np.arange(2) * 1e-3, voltage_V=voltage[:1].repeat(2)), "voltage_V")[1] is None


def test_what_was_no_measurement_in_one_block_is_one_in_the_next() -> None:
    one, other = Layout("voltage", ("current_A",)), Layout("voltage", ("current_A",))
    t, good = np.arange(4) * 1e-3, np.arange(4.0)
    bad = np.full(4, int(Quality.CURRENT_INVALID | Quality.VOLTAGE_INVALID), dtype=np.uint8)
    one.rows(make_block(t - 4e-3, voltage_V=good, current_A=good, quality=bad), 0.0)
    other.rows(make_block(t - 4e-3, voltage_V=good, current_A=good), 0.0)
    block = make_block(t, voltage_V=good, current_A=good)
    assert one.rows(block, 0.0)[:, 5].tolist() == other.rows(block, 0.0)[:, 5].tolist() == [1.0] * 4


def test_a_moving_encoder_is_believed() -> None:
    np.testing.assert_array_equal(doubts([0, 1, 2, 3, 5, 4]), np.ones(6))


def test_a_standing_encoder_says_little_more_than_once() -> None:
    """Weights of all samples on one count together: however long it stands, at most one and a half samples' worth."""
    weights = 1.0 / doubts([0] * 3000)
    assert weights[0] == 1.0
    assert 1.4 < weights.sum() < 1.5 + 1e-6


def test_a_new_count_counts_again() -> None:
    d = doubts([0, 0, 0, 7, 7, 8])
    assert d[3] == 1.0 and d[5] == 1.0 and d[4] == 4.0


@pytest.mark.parametrize("cuts", [(1,), (2, 3), (1, 2, 3, 4, 5, 6, 7)])
def test_blocks_make_no_difference(cuts: tuple[int, ...]) -> None:
    counts = [4, 4, 4, 5, 5, 4, 4, 4, 4]
    np.testing.assert_array_equal(rows_of(counts, cuts), rows_of(counts))


@pytest.mark.parametrize("samples_per_count", [3.1, 7.7, 40.3])
def test_a_slow_shaft_is_shown_hardly_ahead(samples_per_count: float) -> None:
    """With their weights the samples of a shaft at constant speed would be ahead of it by 0.24 to 0.46 counts. (The
    counter rounds down: its middle is half a count further.)"""
    for direction in (1, -1):
        true = direction * (np.arange(4000) / samples_per_count) + 0.37
        counts = np.floor(true)
        rows = rows_of(counts)[200:]
        ahead = direction * (np.column_stack([rows[:, 7] / LSB, counts[200:]]) + 0.5 - true[200:, None])
        shown, unshifted = np.average(ahead, axis=0, weights=1.0 / rows[:, 9])
        assert unshifted > 0.2
        assert abs(shown) < 0.5 * unshifted


def test_a_shaft_that_jumps_or_just_moves_is_where_the_encoder_says() -> None:
    counts = [0, 1, 2, 3, 2, 2, 2, 2, 9, 9, 4]
    np.testing.assert_allclose(rows_of(counts)[:, 7], LSB * np.array(counts), rtol=0, atol=1e-18)


def test_without_a_known_step_nothing_is_doubted() -> None:
    layout = Layout("voltage", ("current_A", "position_rad"))
    n = np.zeros(20)
    rows = layout.rows(make_block(np.arange(20) * 1e-3, voltage_V=n, current_A=n, position_rad=n), 0.0)
    np.testing.assert_array_equal(rows[:, 9], np.ones(20))


def test_an_input_that_is_no_measurement_is_held_and_uncertain() -> None:
    """By the drive's word, as NaN, or beyond what any servo has; also across blocks."""
    layout = Layout("voltage", ("current_A", "position_rad"))
    u = np.array([3.0, 4.0, np.nan, 5.0, 1e9, 6.0])
    quality = np.array([0, 0, 0, Quality.VOLTAGE_INVALID, 0, 0], dtype=np.uint8)
    zero = np.zeros(6)
    block = make_block(np.arange(6) * 1e-3, quality=quality, voltage_V=u, current_A=zero, position_rad=zero)
    rows = np.concatenate([layout.rows(block.slice(a, b), 0.25) for a, b in ((0, 3), (3, 6))])
    np.testing.assert_array_equal(rows[:, 2], [3.0, 4.0, 4.0, 4.0, 4.0, 6.0])
    np.testing.assert_array_equal(rows[:, 3], [0.0, 0.0, 0.25, 0.25, 0.25, 0.0])
    assert layout.last_input == 6.0


def test_a_spike_of_the_input_is_put_right_by_the_next_sample() -> None:
    """Wherever blocks end; a step is none, nor is what the input does all the time."""
    u = np.array([1.0, 1.0, 9.0, 2.0, 2.0, 12.0, 12.0, 12.0, 11.0, 12.0, -8.0, -8.0, 0.0, -9.0])
    zero = np.zeros(len(u))
    block = make_block(np.arange(len(u)) * 1e-3, voltage_V=u, current_A=zero, position_rad=zero)
    expected = np.zeros(len(u))
    expected[3], expected[13] = 1.5 - 9.0, -8.5 - 0.0
    for cut in range(1, len(u)):
        layout = Layout("voltage", ("current_A", "position_rad"))
        parts = (block.slice(0, cut), block.slice(cut, len(u)))
        rows = np.concatenate([layout.rows(part, 0.0, spike_limit=2.0) for part in parts])
        np.testing.assert_array_equal(rows[:, -1], expected)
        np.testing.assert_array_equal(rows[:, 2], u)
    layout = Layout("voltage", ("current_A", "position_rad"))
    assert not layout.rows(block, 0.0)[:, -1].any()


def test_a_spike_of_the_current_is_not_believed_at_once() -> None:
    """Wherever blocks end, and with samples in between that are no measurement. A step is doubted for one sample, what
    comes back from a spike is not, nor is a current that just runs, nor a reading of another channel."""
    i = np.array([1.0, 1.1, 9.0, 1.0, 1.1, 6.0, 6.0, 6.1, -9.0, np.nan, 6.0, 9.0, 12.0, 15.0, 18.0, 18.1, 2.0])
    spikes = np.array([0, 0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1], dtype=bool)
    n = len(i)
    columns = {"voltage_V": np.zeros(n), "current_A": i, "position_rad": np.nan_to_num(i)}
    block = make_block(np.arange(n) * 1e-3, **columns)
    for cut in range(1, n):
        layout = Layout("voltage", ("current_A", "position_rad"))
        parts = (block.slice(0, cut), block.slice(cut, n))
        rows = np.concatenate([layout.rows(part, 0.0, current_spike_limit=2.0) for part in parts])
        np.testing.assert_array_equal(rows[:, 6] >= SPIKE, spikes)
        np.testing.assert_array_equal(rows[:, 5] > 0, ~spikes & np.isfinite(i))
        np.testing.assert_array_equal(rows[~spikes, 6], 1.0)
        np.testing.assert_array_equal(rows[:, 9], 1.0)
    assert not (Layout("voltage", ("current_A", "position_rad")).rows(block, 0.0)[:, 6] > 1.0).any()


def test_after_a_gap_nothing_is_a_spike() -> None:
    i = np.array([1.0, 1.1, 9.0, 9.1, 9.0, 1.0])
    columns = {"voltage_V": i * 3.0, "current_A": i, "position_rad": i}
    block = make_block(np.arange(6) * 1e-3, **columns)
    layout = Layout("voltage", ("current_A", "position_rad"))
    layout.rows(block.slice(0, 2), 0.0, spike_limit=2.0, current_spike_limit=2.0)
    layout.resume(2e-3)
    rows = layout.rows(block.slice(2, 6), 0.0, spike_limit=30.0, current_spike_limit=2.0)
    assert (rows[:, 6] >= SPIKE).tolist() == [False, False, False, True]
    assert rows[0, 1] == 0.0


@pytest.mark.parametrize("late", [0, 1], ids=["after it", "with it"])
def test_a_current_that_jumps_with_the_voltage_is_believed(late: int) -> None:
    """Few steps in a tick are no usual change, neither of the voltage nor of the current of a winding that settles
    within a sample."""
    u = np.array([0.0, 0.1, 0.0, 24.0, 24.1, 24.0, 24.0, 24.1, 24.0])
    i = np.array([0.0, 0.0, 0.1, 0.0, 8.0, 8.1, 8.0, 0.5, 8.0])
    block = make_block(np.arange(len(u)) * 1e-3, voltage_V=np.roll(u, late), current_A=i, position_rad=np.zeros(len(u)))
    layout = Layout("voltage", ("current_A", "position_rad"))
    rows = layout.rows(block, 0.0, spike_limit=1.0, current_spike_limit=1.0)
    assert np.flatnonzero(rows[:, 6] >= SPIKE).tolist() == [7]


def test_a_measurement_that_is_none_is_marked() -> None:
    layout = Layout("voltage", ("current_A", "position_rad"))
    i, zero = np.array([1.0, np.inf, -2e5, 2.0]), np.zeros(4)
    quality = np.array([0, 0, 0, Quality.CURRENT_INVALID], dtype=np.uint8)
    rows = layout.rows(
        make_block(np.arange(4) * 1e-3, quality=quality, voltage_V=zero, current_A=i, position_rad=zero), 0.0
    )
    np.testing.assert_array_equal(rows[:, 4:6], [[1.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    np.testing.assert_array_equal(rows[:, 8], np.ones(4))


def test_a_step_of_the_input_that_is_held_adds_up() -> None:
    layout = Layout("voltage", ("current_A", "position_rad"))
    layout.expect_steps(0.0, 0.6)
    u = np.concatenate([[1.0, 1.0, 1.0, 2.0], np.full(150, 3.0)])
    zero = np.zeros(len(u))
    rows = layout.rows(make_block(np.arange(len(u)) * 1e-3, voltage_V=u, current_A=zero, position_rad=zero), 0.0)
    np.testing.assert_allclose(rows[:6, 3], 0.03 * np.array([0, 1, 2, 0, 0, 1]), rtol=1e-12)
    assert rows[:, 3].max() == pytest.approx(3.0)  # no more than a hundred of them


def test_time_is_counted_from_the_origin_and_goes_on_between_blocks() -> None:
    layout = Layout("voltage", ("current_A", "position_rad"))
    layout.origin_s = 10.0
    zero = np.zeros(2)
    parts = [
        layout.rows(make_block(np.array(t), voltage_V=zero, current_A=zero, position_rad=zero), 0.0)
        for t in ([10.0, 10.5], [10.75, 11.75])
    ]
    np.testing.assert_array_equal(np.concatenate(parts)[:, :2], [[0.0, 0.0], [0.5, 0.5], [0.75, 0.25], [1.75, 1.0]])


def test_without_a_compiler_the_rows_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = [0, 0, 0, 1, 1, 2, 2, 2]
    compiled = doubts(counts)
    monkeypatch.setenv("SERVO_DAEMON_CC", "")
    np.testing.assert_array_equal(doubts(counts), compiled)


def of_cubic(n: int = 12, period_s: float = 0.01, lost: int | None = None) -> np.ndarray:
    """The filter's rows for a torque t³, t in periods, whole or in blocks."""
    at = np.delete(np.arange(n, dtype=float), [] if lost is None else [lost])
    block = make_block(period_s * at, position_rad=np.zeros(len(at)), torque_Nm=at**3)
    layout = Layout("torque", ("position_rad",))
    cut = np.concatenate([layout.rows(block.slice(a, b), 0.0) for a, b in ((0, 1), (1, 5), (5, len(block)))])
    np.testing.assert_array_equal(cut, Layout("torque", ("position_rad",)).rows(block, 0.0))
    return cut


def test_a_torque_between_two_samples_is_on_the_curve_through_the_last_four() -> None:
    """Exactly the mean of t³ over each step, and its change; not before there are four samples."""
    off, change = of_cubic()[:, -2:].T
    k = np.arange(12.0)
    mean, line = (k**4 - (k - 1) ** 4) / 4.0, (k**3 + (k - 1) ** 3) / 2.0
    np.testing.assert_allclose(off[4:], (mean - line)[4:], atol=1e-9)
    np.testing.assert_allclose(change[4:], (k**3 - (k - 1) ** 3)[4:], atol=1e-9)
    assert not off[:3].any() and not change[:3].any()


def test_short_steps_have_no_bend_nor_has_what_is_beside_a_gap() -> None:
    assert not of_cubic(period_s=1e-3)[:, -2:].any()
    off = of_cubic(lost=6)[:, -2]
    assert off[:6].any() and not off[6:9].any() and off[9:].any()
