"""Kept captures as files, and the last samples as a scope shows them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servo_daemon.api.app import create_app
from servo_daemon.api.recorded.scope import MOST_SAMPLES, Trigger, edges, take
from servo_daemon.api.schemas import recorded as schemas
from servo_daemon.errors import BusyError
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.published.archive import KeptCapture
from servo_daemon.samples import SampleBlock, make_block
from tests.fake_daemon import T0, FakeCaptures, FakeDaemon, fake_daemon
from tests.http_rig import Client

DRIVE = "/api/v1/drives/axis1"


@pytest.fixture
def kept(tmp_path: Path) -> FakeCaptures:
    path = tmp_path / "20261121T120000000Z-60000ms-alarm.parquet"
    path.write_bytes(b"samples")
    return FakeCaptures([KeptCapture(path.name.partition(".")[0], "axis1", "alarm", T0, T0 + 60, 7, path)])


@pytest.fixture
def daemon(kept: FakeCaptures) -> FakeDaemon:
    daemon = fake_daemon()
    daemon.captures = kept
    return daemon


@pytest.fixture
def client(daemon: FakeDaemon) -> Client:
    return Client(create_app(daemon))


def test_list_and_file(client: Client, kept: FakeCaptures) -> None:
    document = client.get(f"{DRIVE}/captures").json()
    schemas.CapturesDocument.model_validate(document)
    (capture,) = document["captures"]
    assert (capture["kind"], capture["start"], capture["end"]) == (
        "alarm", "2026-11-21T12:00:00.000Z", "2026-11-21T12:01:00.000Z",
    )  # fmt: skip
    answer = client.get(capture["url"])
    assert answer.status_code == 200 and answer.content == b"samples"
    assert answer.headers["content-type"] == "application/vnd.apache.parquet"
    assert 'filename="axis1-20261121T120000000Z-60000ms-alarm.parquet"' in answer.headers["content-disposition"]
    kept.captures[0].path.unlink()
    assert client.get(capture["url"]).json()["code"] == "unknown_capture"
    assert client.get(f"{DRIVE}/captures/..%2f..%2fstate").status_code == 404


def test_record(client: Client, kept: FakeCaptures) -> None:
    answer = client.post(f"{DRIVE}/captures", json={"seconds": 12})
    assert answer.status_code == 201 and schemas.CaptureDocument.model_validate(answer.json())
    assert client.post(f"{DRIVE}/captures").status_code == 201
    assert kept.asked == [12, 60]
    assert client.post(f"{DRIVE}/captures", json={"seconds": 0}).status_code == 422
    kept.refusal = BusyError("no samples are there")
    refused = client.post(f"{DRIVE}/captures")
    assert (refused.status_code, refused.json()["detail"]) == (409, "No samples are there.")


def test_without_a_place_for_them(daemon: FakeDaemon) -> None:
    daemon.captures = None
    client = Client(create_app(daemon))
    document = client.get(f"{DRIVE}/captures").json()
    assert document["captures"] == [] and "captures_quota_MB" in document["reason"]
    refused = client.post(f"{DRIVE}/captures")
    assert refused.status_code == 409 and "[storage] state_dir" in refused.json()["detail"]


def ticks(seconds: float = 20.0, rate: float = 1000.0) -> tuple[SampleBlock, ...]:
    """A sine of 1 Hz that is noisy in the current, from device time 100 s on."""
    rng = np.random.default_rng(1)
    ring = SampleRing(60.0)
    n = round(rate / 10)
    for k in range(round(10 * seconds)):
        time = 100 + (k * n + np.arange(n)) / rate
        wave = np.sin(2 * np.pi * time)
        ring.append(make_block(time, voltage_V=wave * 10, current_A=wave + 0.02 * rng.standard_normal(n)))
    return ring.blocks()


def test_the_last_samples(client: Client, daemon: FakeDaemon) -> None:
    for block in ticks():
        daemon.drives["axis1"].ring.append(block)
    document = client.get(f"{DRIVE}/samples?seconds=0.5").json()
    schemas.SamplesDocument.model_validate(document)
    assert document["trigger"] is None and document["last_s"] == pytest.approx(119.999)
    assert np.allclose(document["time_s"], 119.499 + np.arange(501) / 1000, atol=1e-6)
    assert document["signals"]["voltage_V"] == pytest.approx(
        10 * np.sin(2 * np.pi * np.array(document["time_s"])), abs=1e-5
    )
    wrong = client.get(f"{DRIVE}/samples?trigger=current")
    assert wrong.status_code == 422 and "voltage_V, current_A" in wrong.json()["detail"]
    newer = client.get(f"{DRIVE}/samples?seconds=5&since=119.9").json()
    assert newer["time_s"][0] >= 119.9


@pytest.mark.parametrize(("edge", "phase"), [("rising", 1 / 12), ("falling", 5 / 12)])
def test_a_noisy_signal_triggers_once_an_edge(edge: Any, phase: float) -> None:
    found = take(ticks(), 0.5, Trigger("current_A", 0.5, edge, 0.2), None)
    assert found.block is not None and found.trigger_s is not None
    assert found.trigger_s % 1 == pytest.approx(phase, abs=0.02)
    assert 118.5 < found.trigger_s < 119.6  # the last of which all is there
    assert found.block.time_s[[0, -1]] == pytest.approx([found.trigger_s - 0.1, found.trigger_s + 0.4], abs=2e-3)
    values = np.concatenate([b.current_A for b in ticks()])  # type: ignore[misc]
    assert len(edges(values, 0.5, edge)) in (19, 20)
    assert take(ticks(), 0.5, Trigger("current_A", 0.5, edge, 0.2), found.trigger_s).block is None
    assert take(ticks(), 0.5, Trigger("current_A", 5.0, edge, 0.2), None).trigger_s is None


def test_a_snapshot_is_bounded_around_its_trigger() -> None:
    found = take(ticks(rate=20_000.0), 5.0, Trigger("voltage_V", 5.0, "rising", 0.5), None)
    assert found.shortened and found.block is not None and len(found.block) == MOST_SAMPLES
    assert found.trigger_s == pytest.approx(found.block.time_s[MOST_SAMPLES // 2], abs=1e-3)
    assert take((), 1.0, None, None).block is None


def test_what_is_no_measurement_is_null(client: Client, daemon: FakeDaemon) -> None:
    volts = np.array([1.0, np.nan, 3.0])
    daemon.drives["axis1"].ring.append(make_block(np.array([0.0, 0.1, 0.2]), voltage_V=volts, current_A=volts * 1e-9))
    signals = client.get(f"{DRIVE}/samples").json()["signals"]
    assert signals == {"voltage_V": [1.0, None, 3.0], "current_A": [1e-9, None, 3e-9]}
