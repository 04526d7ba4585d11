"""The daemon in this process, with drives that do what the test says: no port, no server."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from drivers.base import OnboardEstimates
from servo_daemon.config import parse_config
from servo_daemon.daemon import load
from servo_daemon.daemon import slot as slot_module
from servo_daemon.daemon import worker as worker_module
from servo_daemon.daemon.daemon import Daemon
from servo_daemon.daemon.lines import reader as reader_module
from servo_daemon.daemon.notify import Notifier
from servo_daemon.errors import DriverConfigError, DriverDisconnectedError
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import Quality, SampleBlock
from servo_daemon.signal_meaning import SignalMeaning
from servo_daemon.simulate import DEFAULT_NOMINAL, PAPER_MOTOR, SimulatedDrive, make_settings
from tests.can_tools import frames_of, new_channel, virtual_sender
from tests.daemon_rig import PATIENCE_S, Fed, Rig, configuration, starter


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Rig]]:
    with starter(monkeypatch) as begin:
        yield begin


def test_samples_become_a_snapshot(start: Callable[..., Rig]) -> None:
    rig = start()
    before = rig.snapshot()
    assert before.estimate is None and before.time is None and before.connection == "connecting"
    rig.driver().onboard = OnboardEstimates("tracking", {"R": (0.5, 0.01)}, time.monotonic())
    rig.driver().feed(4000)
    snapshot = rig.until_samples(4000)
    assert snapshot.estimate is not None and snapshot.estimate.samples == 4000
    assert snapshot.counters["samples"] == 4000 and snapshot.counters["samples_lost"] == 0
    assert rig.statuses() == {"tracking"}
    assert snapshot.estimate.estimators["onboard"].parameters == {"R": (0.5, 0.01)}
    assert snapshot is rig.snapshot(), "the same object until the next one is published"
    assert rig.daemon.problems() == []


@pytest.mark.parametrize(("signals", "factor"), [({}, 1.0), ({"publish": "phase"}, 1.0 / math.sqrt(2.0))])
def test_what_the_drivers_signals_mean_is_what_the_daemon_takes_them_for(
    start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch, signals: dict[str, str], factor: float
) -> None:
    """A drive that reports the q axis of a motor whose values line to line are the simulated one's; a key of the
    configuration stands above what the driver says."""
    told = SignalMeaning("instant", "instant", "dq", "line")
    monkeypatch.setattr(Fed, "meaning", told)
    rig = start(configuration("one", nominal={}, signals=signals))
    for _ in range(16):
        block = rig.driver("one").source.next_block(500)
        assert block.voltage_V is not None and block.current_A is not None
        v, i = block.voltage_V / math.sqrt(3.0), block.current_A * 2.0 / math.sqrt(3.0)
        rig.driver("one").put(replace(block, voltage_V=v, current_A=i))
    estimate = rig.until_samples(8000, "one").estimate
    assert rig.runtime("one").meaning == (replace(told, publish="phase") if signals else told)
    assert estimate is not None
    assert set(estimate.equivalents) == {"phase", "line", "kt"} - {"phase" if signals else "line"}
    K = next(p for p in estimate.parameters if p.name == "K")
    assert K.value == pytest.approx(factor * PAPER_MOTOR["K"], rel=0.05)


def test_a_slow_worker_loses_the_oldest_and_says_how_many(
    start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = start(run=False)
    queue = rig.runtime().reader.queue
    monkeypatch.setattr(queue, "_capacity", 3000)
    monkeypatch.setattr(load, "LATE_S", math.inf)  # however long this machine takes for the first round
    rig.runtime().reader.start()  # nobody works yet
    for _ in range(100):
        rig.driver().feed(100)
    rig.until(lambda: rig.driver().fed == 10_000 and queue.samples + queue.dropped == 10_000, "all queued or dropped")
    assert queue.dropped == 7000
    rounds = [rig.runtime().work() for _ in range(7)]
    assert rounds == [True] * 6 + [False], "500 samples in a round"
    snapshot = rig.snapshot()
    assert snapshot.estimate is not None
    assert snapshot.counters["samples"] == 10_000
    assert snapshot.counters["queue_dropped"] == snapshot.counters["samples_lost"] == 7000
    assert snapshot.estimate.samples == 3000, "what was not dropped is used"


def test_drives_begin_one_after_another(start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    """Else what each has to do every two seconds is done by all at the same moment."""
    begun_s: list[float] = []
    monkeypatch.setattr(reader_module.Reader, "start", lambda _, after_s: begun_s.append(after_s))
    start(configuration("one", "two", "three", "four"))
    assert begun_s == [0.0, 0.5, 1.0, 1.5]


def test_one_of_two_drives_dies(start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "LATE_S", math.inf)  # however long the second waits for the first one's start
    rig = start(configuration("one", "two"))
    for _ in range(30):
        for name in ("one", "two"):
            rig.driver(name).feed(100)
    rig.until_samples(3000, "one"), rig.until_samples(3000, "two")
    values = {p.name: p.value for p in rig.snapshot("one").estimate.parameters}  # type: ignore[union-attr]
    rig.driver("one").put(DriverDisconnectedError("drive one: device went away: unplugged"))
    for _ in range(30):
        rig.driver("two").feed(100)
    rig.until_samples(6000, "two")
    rig.until(lambda: "disconnected" in rig.kinds("one"), "told")
    rig.until(lambda: rig.snapshot("one").connection != "connected", "published")
    one, two = rig.snapshot("one"), rig.snapshot("two")
    assert one.estimate is not None
    assert {p.status for p in one.estimate.parameters} == {"invalid"}
    assert {p.name: p.value for p in one.estimate.parameters} == values, "values are kept"
    assert rig.statuses("two") == {"tracking"}
    assert two.counters["samples_lost"] == 0 and rig.kinds("two") == ["connected", "filter_started"]


def test_a_failing_pipeline_starts_over_and_leaves_the_others_alone(
    start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rig = start(configuration("one", "two"))
    for name in ("one", "two"):
        rig.driver(name).feed(2000)
        rig.until_samples(2000, name)
    pipeline = rig.runtime("one")._estimation._pipeline

    def fail(*_block: SampleBlock, **_how: bool) -> Any:
        raise FloatingPointError("made up")

    with monkeypatch.context() as patched:
        patched.setattr(pipeline, "process", fail)
        for failures in (1, 2, 3):
            rig.driver("one").feed(100)
            rig.until(lambda n=failures: rig.snapshot("one").counters["pipeline_failures"] == n, "it failed")
    assert rig.snapshot("one").estimate is None
    assert rig.kinds("one")[-1] == "pipeline_failed"
    assert rig.kinds("one").count("pipeline_failed") == 1, "three failures in a row are told once"
    assert caplog.text.count("FloatingPointError: made up") == 1
    for name in ("one", "two"):
        rig.driver(name).feed(2000)
    rig.until(lambda: rig.kinds("one")[-1] == "filter_started", "started over")
    rig.until_samples(4000, "two")
    assert rig.kinds("two") == ["connected", "filter_started"]


def test_a_device_restart_is_told_once_and_its_parameters_go_on(start: Callable[..., Rig]) -> None:
    rig = start()
    rig.driver().feed(4000)
    rig.until_samples(4000)
    again = rig.driver().source.next_block(1000)
    position = again.position_rad
    assert position is not None
    rig.driver().put(replace(again, time_s=again.time_s - again.time_s[0], position_rad=position - position[0]))
    snapshot = rig.until_samples(5000)
    assert snapshot.estimate is not None
    for p in snapshot.estimate.parameters:
        if p.name in PAPER_MOTOR:
            assert p.status == "tracking" and p.value == pytest.approx(PAPER_MOTOR[p.name], rel=0.05)
    rig.until(lambda: "device_restarted" in rig.kinds(), "told")
    assert rig.kinds() == ["connected", "filter_started", "device_restarted"]


def test_another_device_starts_from_nothing(start: Callable[..., Rig], tmp_path: Path) -> None:
    rig = start(state=tmp_path)
    rig.driver().feed(4000)
    rig.until_samples(4000)
    rig.until((tmp_path / "axis1.state.json").exists, "saved")
    rig.driver().identity = "another"
    rig.driver().feed(100)
    rig.until(lambda: "device_changed" in rig.kinds(), "noticed")
    rig.until(lambda: (e := rig.snapshot().estimate) is not None and e.samples == 100, "a pipeline of its own")
    assert rig.statuses() == {"estimating"}
    assert "state_restored" not in rig.kinds()


def test_a_driver_that_does_not_know_the_device_yet_changes_nothing(start: Callable[..., Rig]) -> None:
    """Between two attachments what still waits in the queue is the last device's."""
    rig = start()
    rig.driver().feed(4000)
    rig.until_samples(4000)
    identity, rig.driver().identity = rig.driver().identity, ""
    rig.driver().feed(100)
    rig.until_samples(4100)
    rig.driver().identity = identity
    rig.driver().feed(100)
    rig.until_samples(4200)
    assert "device_changed" not in rig.kinds() and rig.statuses() == {"tracking"}


def test_state_survives_a_restart_of_the_daemon(start: Callable[..., Rig], tmp_path: Path) -> None:
    first = start(state=tmp_path)
    first.driver().feed(6000)
    first.until_samples(6000)
    first.daemon.stop(PATIENCE_S)
    assert (tmp_path / "axis1.state.json").exists(), "saved on the way out"
    second = start(state=tmp_path)
    second.driver().source.next_block(6000)
    second.driver().feed(500)
    second.until_samples(500)
    second.until(lambda: "filter_started" in second.kinds(), "started")
    assert second.kinds().count("state_restored") == 1
    assert second.statuses() == {"tracking"}, "half a second after the first sample"


def test_a_reset_forgets_estimates_and_file(start: Callable[..., Rig], tmp_path: Path) -> None:
    rig = start(state=tmp_path)
    rig.driver().feed(4000)
    rig.until_samples(4000)
    rig.until((tmp_path / "axis1.state.json").exists, "saved")
    rig.runtime().request_reset()
    rig.until(lambda: "reset" in rig.kinds(), "carried out")
    assert not (tmp_path / "axis1.state.json").exists()
    rig.until(lambda: rig.snapshot().estimate is None, "published, with or without samples")
    rig.driver().feed(100)
    rig.until(lambda: rig.snapshot().estimate is not None, "published again")
    assert rig.statuses() == {"estimating"}


def test_a_silent_drive_is_invalid_and_recovers(start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_module, "SILENT_AFTER_S", 0.2)
    rig = start()
    rig.driver().feed(4000)
    rig.until_samples(4000)
    rig.until(lambda: rig.snapshot().connection == "silent", "silent")
    estimate = rig.snapshot().estimate
    assert estimate is not None
    assert {p.status for p in estimate.parameters} == {"invalid"}
    assert {"open, but no samples for" in str(p.reason) for p in estimate.parameters} == {True}
    assert all(p.value is not None and p.std is not None for p in estimate.parameters)
    rig.driver().feed(200)
    rig.until_samples(4200)
    rig.until(lambda: rig.kinds()[-1] == "speaking", "told")
    assert rig.kinds() == ["connected", "filter_started", "silent", "speaking"]
    last = rig.runtime().history.query("R").status
    assert last is not None and len(last) > 0


def test_the_hosts_clock_may_jump(start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    """An hour back, then a day forward: device time drives the physics, so nothing but the time stamps changes."""
    rig = start()
    step_s, real = [0.0], time.time
    monkeypatch.setattr("servo_daemon.daemon.drive.time.time", lambda: real() + step_s[0])
    rig.driver().feed(4000)
    rig.until_samples(4000)
    total = 4000
    for jump in (-3600.0, 86_400.0):
        step_s[0] = jump
        for _ in range(5):
            rig.driver().feed(200)
            total += 200
            snapshot = rig.until_samples(total)
        assert snapshot.time == pytest.approx(real() + jump, abs=PATIENCE_S)
        assert rig.statuses() == {"tracking"} and snapshot.connection == "connected"
    series = rig.runtime().history.query("R")
    assert (np.diff(series.time_s) >= 0).all() and len(series) >= 3
    assert np.isfinite(series.value).all()
    assert rig.kinds() == ["connected", "filter_started"]
    assert snapshot.estimate is not None and snapshot.estimate.health["filter_restarts"] == 0


def test_channels_that_come_and_go(start: Callable[..., Rig]) -> None:
    """A drive that stops sending its current is one with other signals, not an error."""
    rig = start()
    rig.driver().feed(2000)
    rig.until_samples(2000)
    block = rig.driver().source.next_block(1000)
    rig.driver().put(replace(block, current_A=None))
    rig.until_samples(3000)
    assert rig.statuses() <= {"estimating", "fixed"}
    rig.driver().feed(4000)  # a start without nominal values to trust is gone over before it is published
    rig.until_samples(7000)
    rig.until(lambda: rig.statuses() == {"tracking"}, "tracks again")
    assert rig.snapshot().counters["pipeline_failures"] == 0


def test_quality_bits_of_a_drive_reach_the_filter(start: Callable[..., Rig]) -> None:
    rig = start()
    rig.driver().feed(4000)
    rig.until_samples(4000)
    block = rig.driver().source.next_block(1000)
    assert block.current_A is not None
    rig.driver().put(
        replace(
            block,
            quality=np.full(1000, Quality.CURRENT_INVALID, np.uint8),
            current_A=np.full(1000, 7.7),
        )
    )
    snapshot = rig.until_samples(5000)
    assert snapshot.estimate is not None
    for p in snapshot.estimate.parameters:
        if p.name in PAPER_MOTOR:
            assert p.value == pytest.approx(PAPER_MOTOR[p.name], rel=0.05)
    assert snapshot.counters["samples"] == snapshot.estimate.samples == 5000


def test_wrong_options_keep_the_daemon_from_being_made() -> None:
    config = parse_config({"drive": [{"driver": "simulated", "options": {"warp": 9}}]})
    with pytest.raises(DriverConfigError, match="warp"):
        Daemon(config)


def test_a_worker_that_hangs_is_a_problem(start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slot_module, "STUCK_S", 0.2)
    rig = start()
    released = threading.Event()
    work = rig.runtime().work

    def hang() -> bool:
        released.wait(PATIENCE_S)
        return work()

    try:
        monkeypatch.setattr(rig.runtime(), "work", hang)
        rig.until(rig.daemon.problems, "noticed")
        assert "has not turned" in rig.daemon.problems()[0]
    finally:
        released.set()
    rig.until(lambda: not rig.daemon.problems(), "and over")


class Gate:
    """Holds up a call of one drive until it is opened, and notes who is in there."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str) -> None:
        self.opened, self.entered = threading.Event(), threading.Event()
        original = getattr(owner, name)

        def held(*args: Any, **how: Any) -> Any:
            self.entered.set()
            assert self.opened.wait(PATIENCE_S)
            return original(*args, **how)

        monkeypatch.setattr(owner, name, held)


@pytest.mark.parametrize("quick_s", [0.0, 1e3])
def test_what_takes_one_drive_long_holds_up_no_other(
    start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch, quick_s: float
) -> None:
    """As long as the test likes, whether it happens in the thread that all share or in one of those that take long: the
    neighbours work off all that comes, and both go on afterwards."""
    monkeypatch.setattr(worker_module, "_QUICK_S", quick_s)
    rig = start(configuration("one", "two", "three"))
    for name in ("one", "two", "three"):
        rig.driver(name).feed(500)
        rig.until_samples(500, name)
    gates = [Gate(monkeypatch, rig.runtime(name)._estimation._pipeline, "process") for name in ("one", "two")]
    try:
        for name in ("one", "two", "three"):
            rig.driver(name).feed(500)
        for gate in gates:
            assert gate.entered.wait(PATIENCE_S), "the second one is not held up by the first"
        monkeypatch.setattr(slot_module, "LONG_TURN_S", 0.0)  # the third one's turns take long, too
        monkeypatch.setattr(worker_module, "_QUICK_S", 1e3)
        for _ in range(30):
            rig.driver("three").feed(100)
        rig.until_samples(4000, "three")
        assert rig.statuses("three") == {"tracking"}
        assert rig.snapshot("three").counters["samples_lost"] == 0
        held = rig.snapshot("one").estimate
        assert held is not None and held.samples == 500
    finally:
        for gate in gates:
            gate.opened.set()
    for name in ("one", "two"):
        rig.driver(name).feed(500)
        rig.until_samples(1500, name)


def test_no_drive_is_turned_by_two_threads_at_once_and_a_quick_one_shares_again(
    start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every turn is taken for a long one for a while, then none is: drives go to threads of their own and come back."""
    monkeypatch.setattr(worker_module, "_QUICK_S", 0.0)
    rig = start(configuration("one", "two", "three"))
    slots = rig.daemon._slots
    inside, threads, crossed = dict.fromkeys(slots, 0), set(), []
    for name in slots:
        monkeypatch.setattr(rig.runtime(name), "work", counted(rig.runtime(name).work, name, inside, threads, crossed))
    for k in range(1, 4):
        monkeypatch.setattr(slot_module, "LONG_TURN_S", 0.0)
        for _ in range(20):
            for name in slots:
                rig.driver(name).feed(50)
        rig.until(lambda: any(slot.takes_long for slot in slots.values()), "one has a thread of its own")
        for name in slots:
            rig.until_samples(k * 1000, name)
        monkeypatch.setattr(slot_module, "LONG_TURN_S", 60.0)
        rig.until(lambda: all(not slot.takes_long for slot in slots.values()), "all share a thread again")
    assert crossed == [] and len(threads) > 3
    assert all(rig.snapshot(name).counters["samples_lost"] == 0 for name in slots)


def counted(work: Any, name: str, inside: dict[str, int], threads: set[Any], crossed: list[str]) -> Any:
    """`work` that notes which threads are in it, and whether two ever were."""

    def noted() -> bool:
        inside[name] += 1
        threads.add(threading.current_thread())
        if inside[name] > 1:
            crossed.append(name)
        try:
            return bool(work())
        finally:
            inside[name] -= 1

    return noted


class Supervisor(Notifier):
    """Counts how often it is told that the daemon is alive."""

    fed = 0

    def watchdog(self) -> None:
        self.fed += 1


def test_an_estimator_in_the_making_is_no_problem_and_a_pipeline_that_hangs_is(
    start: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does the one keep the watchdog from being fed, as the other does."""
    monkeypatch.setattr(slot_module, "STUCK_S", 0.2)
    supervisor = Supervisor(watchdog_s=0.02)
    rig = start(configuration("one", "two"), notifier=supervisor)
    slot = rig.daemon._slots["one"]

    def problems() -> list[str]:  # (the machine may be too slow for the other one, at this limit)
        return [p for p in rig.daemon.problems() if p.startswith("drive one: the pipeline has not turned")]

    making = Gate(monkeypatch, Pipeline, "_tracker_for")
    try:
        rig.driver("one").feed(100)
        assert making.entered.wait(PATIENCE_S)
        fed = supervisor.fed
        rig.until(lambda: time.monotonic() - slot.turned > 1.0 and supervisor.fed > fed + 3, "it takes long")
        assert problems() == []
    finally:
        making.opened.set()
    rig.until_samples(100, "one")
    hangs = Gate(monkeypatch, rig.runtime("one")._estimation._pipeline, "process")
    try:
        rig.driver("one").feed(100)
        assert hangs.entered.wait(PATIENCE_S)
        rig.until(problems, "noticed")
        fed = supervisor.fed
        rig.until(lambda: time.monotonic() - slot.turned > 1.0, "it hangs")
        assert supervisor.fed <= fed + 1, "systemd is not told that all is well"
    finally:
        hangs.opened.set()
    rig.until(lambda: not problems() and supervisor.fed > fed + 2, "and over")


def test_stop_is_idempotent_and_ends_every_thread(start: Callable[..., Rig]) -> None:
    rig = start(configuration("one", "two"))
    names = {"pipeline", "watch", "saver", "reader-one", "reader-two"}
    assert names <= {t.name for t in threading.enumerate()}
    assert not rig.daemon.stopping()
    rig.daemon.begin_stop()
    assert rig.daemon.stopping()
    rig.daemon.stop(PATIENCE_S)
    rig.daemon.stop(PATIENCE_S)
    assert not names & {t.name for t in threading.enumerate()}


# -- CAN, whose bus is in this process ---------------------------------------------------------------------------


def test_can_error_frames_are_counted_and_bus_off_is_a_line_that_went_down(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    channel = new_channel()
    options = {"interface": "virtual", "channel": channel}
    drive = {"driver": "can", "options": options, "nominal": dict(DEFAULT_NOMINAL)}
    daemon = Daemon(parse_config({"drive": [drive]}))
    rig = Rig(daemon)
    daemon.start()
    source = SimulatedDrive(make_settings(seed=1))
    other = can.Bus(interface="virtual", channel=channel, ignore_config=True)

    def error_frame(bits: int) -> can.Message:
        return can.Message(arbitration_id=bits, is_error_frame=True, is_extended_id=False, dlc=8, data=bytes(8))

    try:
        with virtual_sender(channel) as send:
            rig.until(lambda: rig.kinds() == ["connected"], "open")
            frames = frames_of(source, 4000)
            for start in range(0, len(frames), 500):
                send(frames[start : start + 500])
                other.send(error_frame(0x08))  # a protocol violation on the wire
            rig.until_samples(4000)
            counters = rig.snapshot().counters
            assert counters["error_frames"] == counters["framing_errors"] > 5
            assert counters["samples"] == 4000 and counters["samples_lost"] == 0
            assert rig.statuses() == {"tracking"}
            other.send(error_frame(0x40))  # bus off
            rig.until(lambda: "disconnected" in rig.kinds(), "bus off")
            rig.until(lambda: rig.kinds()[-1] == "connected", "and opened again")
        rig.until(lambda: rig.snapshot().counters["reconnects"] == 1, "counted in the next snapshot")
        assert caplog.text.count("bus-off") == 1
    finally:
        other.shutdown()
        daemon.stop(PATIENCE_S)
