"""Lines that fail: what the API says, what the log says (once), and that every good sample arrives."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from drivers.serial.encoder import BinaryEncoder, describe
from servo_daemon.sim_drive.counters import DeviceCounters
from servo_daemon.sim_drive.line_faults import Fault, LineFaults
from servo_daemon.sim_drive.serial_device import run_serial_device
from servo_daemon.sim_drive.slcan_device import SlcanFaults, run_slcan_device
from servo_daemon.simulate import PAPER_MOTOR, SimulatedDrive, make_settings
from tests.system.harness import (
    LINEAR,
    Fetched,
    all_tracking,
    assert_close,
    daemon,
    nominal_table,
    sim_drive,
    statuses,
    wait_for,
    write_config,
)

SAMPLES = 12_000
PER_FRAME = 10


def serial_config(name: str, link: Path) -> str:
    return f'name = "{name}"\ndriver = "serial"\n{nominal_table()}[drive.options]\nport = "{link}"'


def slcan_config(name: str, link: Path) -> str:
    return f'name = "{name}"\ndriver = "can"\n{nominal_table()}[drive.options]\ninterface = "slcan"\nchannel = "{link}"'


@contextlib.contextmanager
def device(target: Callable[..., Any], link: Path, **arguments: Any) -> Iterator[None]:
    """A simulated device in a thread of this process, which can be told to misbehave."""
    stop, failures = threading.Event(), list[BaseException]()

    def run() -> None:
        try:
            target(link, stop=stop, **arguments)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        wait_for(lambda: link.is_symlink() or failures, f"{link} appears")
        yield
    finally:
        stop.set()
        thread.join(10)
        assert not thread.is_alive() and not failures, failures


def finite_drive() -> Fetched:
    return Fetched(SimulatedDrive(make_settings(seed=5)), SAMPLES)


@pytest.mark.slow
def test_missing_unplugged_and_back_while_another_drive_goes_on(tmp_path: Path) -> None:
    """A port that is missing at the start, comes, goes and comes back; beside it a drive that never notices."""
    links = {"serial": tmp_path / "servo0", "slcan": tmp_path / "can0"}
    config = write_config(
        tmp_path / "c.toml",
        serial_config("serial", links["serial"]),
        slcan_config("slcan", links["slcan"]),
        f'name = "other"\n{nominal_table()}',
    )
    with daemon("--config", config, "--state-dir", tmp_path / "state") as program:
        for name, link in links.items():
            missing = program.until(lambda d: d["health"]["connection_reason"] != "not opened yet", "told", name)
            assert str(link) in missing["health"]["connection_reason"]
            assert missing["health"]["connection"] == "connecting"
            assert statuses(missing) == {"estimating"} and missing["time"] is None
            assert {p["value"] == p["nominal"] for p in missing["parameters"].values()} == {True}
            assert program.foreground_events(name) == ["unavailable"]
        other = program.until(all_tracking, "the other drive tracks", "other")
        assert program.get("/ready")["ready"] is True  # one drive is enough
        assert program.get("/health")["status"] == "ok"  # a missing port is no trouble of the daemon

        with sim_drive("serial", links["serial"]), sim_drive("slcan", links["slcan"]):
            before = {name: program.until(all_tracking, f"{name} tracks", name) for name in links}
        for name in links:
            down = program.until(lambda d: d["health"]["connection"] == "down", f"{name} is down", name)
            assert statuses(down) == {"invalid"}
            assert all("next attempt in" in p["reason"] for p in down["parameters"].values())
            assert all(down["parameters"][n]["value"] is not None for n in LINEAR)
            assert program.get("/health")["status"] == "ok"

        with sim_drive("serial", links["serial"]), sim_drive("slcan", links["slcan"]):
            for name in links:
                back = program.until(all_tracking, f"{name} tracks again", name)
                assert back["health"]["reconnects"] == 1
                assert back["health"]["filter_restarts"] == 0
                assert_close(back, PAPER_MOTOR)  # at once: parameters outlive the line
                assert back["samples"] > before[name]["samples"]
                assert back["samples"] <= back["health"]["samples"]
                kinds = [k for k in program.foreground_events(name) if k != "device_restarted"]
                assert kinds == ["unavailable", "connected", "filter_started", "disconnected", "connected"]
            for name in links:
                assert program.said(f"WARNING drive {name}: ") in (2, 3)  # missing, gone, and perhaps restarted
                assert program.said(f"drive {name}: device went away") == 1
                assert program.said(f"drive {name}: device opened") == 1
                assert program.said(f"drive {name}: device is back") == 1

        end = program.estimates("other")
        assert all_tracking(end) and end["samples"] > other["samples"]
        assert end["health"]["samples_lost"] == 0 and end["health"]["reconnects"] == 0
        assert set(program.foreground_events("other")) == {"connected", "filter_started"}
        status = program.get("/drives/other/history?parameter=R&points=20000")["status"]
        first = status.index("tracking")
        assert set(status[first:]) == {"tracking"}, "the other drive tracks without a break"


@pytest.mark.slow
def test_every_fault_of_a_serial_line(tmp_path: Path) -> None:
    """Lost, repeated, changed and cut frames and noise: counted, and everything else arrives."""
    at = {
        300: Fault.DROP, 301: Fault.DROP, 400: Fault.REPEAT, 500: Fault.CORRUPT, 600: Fault.CUT, 700: Fault.GARBAGE,
        800: Fault.REPEAT, 900: Fault.CORRUPT,
    }  # fmt: skip
    lost = PER_FRAME * 5 + PER_FRAME  # dropped 2, changed 2, cut 1 and the one that ran into it
    counters, link = DeviceCounters(), tmp_path / "servo0"
    config = write_config(tmp_path / "c.toml", serial_config("axis1", link))
    faulty = device(
        run_serial_device, link, source=finite_drive(), realtime=False, faults=LineFaults(at), counters=counters
    )
    with faulty, daemon("--config", config, "--state-dir", tmp_path / "state") as program:
        silent = program.until(lambda d: d["health"]["connection"] == "silent", "all sent")
        health = silent["health"]
        assert counters.samples == SAMPLES and counters.overruns == 0
        assert health["samples"] + health["samples_lost"] == SAMPLES
        assert health["samples_lost"] == lost
        assert health["samples_repeated"] == 2
        assert health["crc_errors"] + health["framing_errors"] >= 4
        assert health["crc_errors"] >= 2
        assert silent["samples"] == health["samples"], "every good sample went through the estimators"
        assert health["device_restarts"] == 0 and health["filter_restarts"] == 0
        assert statuses(silent) == {"invalid"}
        assert {"no samples for" in p["reason"] for p in silent["parameters"].values()} == {True}
        assert_close(silent, PAPER_MOTOR)
        assert program.foreground_events()[-1] == "silent"
        assert program.said("sends no samples") == 1


def test_every_fault_of_an_slcan_adapter(tmp_path: Path) -> None:
    """The same on CAN: samples lost, sent twice, cut in the middle, and bytes that are no line at all."""
    link = tmp_path / "can0"
    faults = SlcanFaults(
        lose=frozenset({3000, 3001, 3002}),
        repeat=frozenset({4000}),
        cut=frozenset({5000}),
        garbage={6000: b"\xff\x00garbage\r", 6500: b"t12\r"},
    )
    config = write_config(tmp_path / "c.toml", slcan_config("axis1", link))
    faulty = device(run_slcan_device, link, source=Fetched(SimulatedDrive(make_settings(seed=5)), 10**9),
                    realtime=False, faults=faults)  # fmt: skip
    with faulty, daemon("--config", config, "--state-dir", tmp_path / "state") as program:
        later = program.until(lambda d: d["samples"] > 8000, "the faults are past")
        health = later["health"]
        # The cut line runs into the next one: its sample, and the one or two frames behind it.
        assert 4 <= health["samples_lost"] <= 6
        assert health["samples_repeated"] == 1
        assert health["framing_errors"] >= 2
        assert health["connection"] == "connected" and health["reconnects"] == 0
        assert health["device_restarts"] == 0 and health["filter_restarts"] == 0
        tracking = program.until(all_tracking, "tracks")
        assert_close(tracking, PAPER_MOTOR)
        assert not [line for line in program.log if " WARNING " in line or " ERROR " in line]


@pytest.mark.first_is_fast
@pytest.mark.parametrize("wire", ["serial", "slcan"])
def test_a_device_that_restarts_keeps_its_parameters(tmp_path: Path, wire: str) -> None:
    """Time and numbering begin anew: counted, told once, and the filter goes on with what it knows."""
    link = tmp_path / "link"
    source = Fetched(SimulatedDrive(make_settings(seed=5)), SAMPLES if wire == "serial" else 10**9)
    if wire == "serial":
        faults = LineFaults({SAMPLES // PER_FRAME // 2: Fault.RESTART})
        restarting = device(run_serial_device, link, source=source, realtime=False, faults=faults)
        config = write_config(tmp_path / "c.toml", serial_config("axis1", link))
    else:
        restarting = device(run_slcan_device, link, source=source, realtime=False,
                            faults=SlcanFaults(restart=frozenset({6001})))  # fmt: skip
        config = write_config(tmp_path / "c.toml", slcan_config("axis1", link))
    with restarting, daemon("--config", config, "--state-dir", tmp_path / "state") as program:
        after = program.until(lambda d: d["samples"] > SAMPLES - 100, "well past the restart")
        assert after["health"]["device_restarts"] == 1
        assert after["health"]["filter_restarts"] == 0
        assert after["health"]["samples_lost"] == 0
        assert_close(after, PAPER_MOTOR)
        assert program.events().count("device_restarted") == 1
        assert program.events().count("filter_started") == 1
        assert program.said("the device restarted") == 1


@pytest.mark.slow
def test_a_drive_that_falls_silent_and_speaks_again(tmp_path: Path) -> None:
    """Stopped like a hung device: the port stays open and says nothing."""
    link = tmp_path / "servo0"
    config = write_config(tmp_path / "c.toml", serial_config("axis1", link))
    with (
        sim_drive("serial", link) as drive,
        daemon("--config", config, "--state-dir", tmp_path / "state") as program,
    ):
        before = program.until(all_tracking, "tracks")
        drive.send(signal.SIGSTOP)
        silent = program.until(lambda d: d["health"]["connection"] == "silent", "silent")
        assert statuses(silent) == {"invalid"}
        for name in LINEAR:
            assert "no samples for" in silent["parameters"][name]["reason"]
            assert silent["parameters"][name]["value"] == pytest.approx(before["parameters"][name]["value"], rel=0.05)
        assert program.get("/health")["status"] == "ok"
        drive.send(signal.SIGCONT)
        back = program.until(all_tracking, "tracks again")
        assert back["health"]["connection"] == "connected" and back["health"]["reconnects"] == 0
        assert_close(back, PAPER_MOTOR)
        assert program.foreground_events() == ["connected", "filter_started", "silent", "speaking"]
        assert program.said("sends no samples") == 1 and program.said("sends samples again") == 1


def test_noise_of_a_wrong_baud_rate_then_a_real_device(tmp_path: Path) -> None:
    """Bytes that are no frames are counted and never taken for samples; the first good frames end it."""
    master, slave = os.openpty()
    tty.setraw(slave)
    noise = random.Random(7)
    drive = SimulatedDrive(make_settings(seed=5))
    encoder = BinaryEncoder(describe(drive.info, drive_id=1))
    config = write_config(tmp_path / "c.toml", serial_config("axis1", Path(os.ttyname(slave))))
    try:
        with daemon("--config", config, "--state-dir", tmp_path / "state") as program:
            program.until(lambda d: program.said("device opened"), "opened")
            for _ in range(20):
                os.write(master, noise.randbytes(200))
            silent = program.until(
                lambda d: (
                    d["health"]["connection"] == "silent"
                    and d["health"]["framing_errors"] + d["health"]["crc_errors"] > 5
                ),
                "silent for all the noise",
            )
            assert silent["samples"] == silent["health"]["samples"] == 0
            assert statuses(silent) == {"estimating"}
            assert program.said("sends no samples") == 1

            os.write(master, b"\x00" + encoder.describe())
            for _ in range(300):
                os.write(master, b"".join(encoder.encode(drive.next_block(PER_FRAME))))
            done = program.until(lambda d: d["health"]["samples"] == 300 * PER_FRAME, "every good sample")
            assert done["health"]["samples_lost"] == 0
            assert program.until(lambda d: d["samples"] == 300 * PER_FRAME, "processed")
    finally:
        os.close(master)
        os.close(slave)
