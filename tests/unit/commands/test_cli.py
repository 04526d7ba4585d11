"""The commands: exit codes, one JSON document, and results that depend on nothing but their input."""

from __future__ import annotations

import gzip
import json
import logging
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from drivers.registry import make_driver
from servo_daemon import cli
from servo_daemon.captures import read_capture, write_capture
from servo_daemon.commands.replay.estimates_csv import EstimatesWriter
from servo_daemon.commands.shared.common import capture_info
from servo_daemon.config import DriveConfig
from servo_daemon.errors import EndOfStreamError
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.pipeline.publish import published_names
from servo_daemon.samples import make_block
from servo_daemon.simulate import PAPER_MOTOR
from tests.system.harness import Program, environment, run_once, sim_drive, wait_for, write_config

LINEAR = tuple(PAPER_MOTOR)


@dataclass(frozen=True)
class Result:
    code: int
    out: str
    err: str

    @property
    def document(self) -> Any:
        """The one JSON document on stdout."""
        return json.loads(self.out)


Run = Callable[..., Result]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """The command line in this process."""
    for name in [n for n in os.environ if n.startswith("SERVO_DAEMON_")]:
        monkeypatch.delenv(name)

    def call(*words: str | Path) -> Result:
        capsys.readouterr()
        try:
            code = cli.main([str(w) for w in words])
        except SystemExit as end:
            code = int(end.code or 0)
        text = capsys.readouterr()
        return Result(code, text.out, text.err)

    with own_logging():
        yield call


@contextmanager
def own_logging() -> Iterator[None]:
    """The commands set logging up for a process of their own."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        yield
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six seconds of the paper's motor."""
    path = tmp_path_factory.mktemp("cli") / "motor.csv"
    with own_logging():
        assert cli.main(["simulate", "--out", str(path), "--seconds", "6", "--seed", "4"]) == 0
    return path


# -- help and errors ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_has_an_example_that_parses(run: Run, command: str) -> None:
    result = run(command, "--help")
    assert result.code == 0 and result.err == ""
    _, _, examples = result.out.partition("example:\n")
    lines = examples.replace("\\\n", "").strip().splitlines()
    assert lines
    for line in lines:
        program, name, *words = shlex.split(line, comments=True)
        assert (program, name) == ("servo-daemon", command)
        assert cli._parser().parse_args([name, *words]).command == command


def test_every_command_is_in_the_help(run: Run) -> None:
    result = run("--help")
    assert result.code == 0
    assert set(cli.COMMANDS) <= {line.split()[0] for line in result.out.splitlines() if line.startswith("    ")}
    assert run("--version").out.startswith("servo-daemon ")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "COMMAND"),
        (("fly",), "fly"),
        (("replay",), "CAPTURE"),
        (("replay", "x.csv", "--out", "y.csv", "--speed", "2"), "--speed 2"),
        (("fit", "x.csv", "--counts-per-turn", "2048"), "(did you mean --counts-per-rev?)"),
        (("run", "--confg=a.toml"), "(did you mean --config?)"),
        (("check", "--config", "x.toml", "--xyzzy"), "unrecognized arguments: --xyzzy"),
        (("replay", "none.csv", "--out", "y.csv"), "none.csv"),
        (("replay", "none.csv", "--out", "y.csv", "--block", "0"), "--block"),
        (("replay", "none.csv", "--out", "y.csv", "--block", "many"), "many"),
        (("simulate", "--out", "x.csv", "--effect", "warp"), "warp"),
        (("simulate", "--out", "x.csv", "--seconds", "-1"), "seconds"),
        (("simulate", "--out", "x.csv", "--seconds", "nan"), "seconds"),
        (("simulate", "--out", "x.csv", "--motor", "R=big"), "R=big"),
        (("simulate", "--out", "/nowhere/x.csv", "--seconds", "0.1"), "/nowhere/x.csv"),
        (("record", "--config", "none.toml", "--seconds", "1", "--out", "x.csv"), "none.toml"),
        (("record", "--config", "none.toml", "--seconds", "0", "--out", "x.csv"), "--seconds"),
        (("check", "--config", "none.toml"), "none.toml"),
        (("sim-drive",), "--serial"),
    ],
)
def test_wrong_usage_and_wrong_input_exit_with_2(run: Run, words: tuple[str, ...], says: str) -> None:
    result = run(*words)
    assert result.code == 2
    assert result.out == ""
    assert says in result.err.splitlines()[-1]
    assert "Traceback" not in result.err


@pytest.mark.parametrize(
    "words",
    [
        ("replay", "none.csv", "--out", "y.csv"),
        ("replay", "none.csv"),
        ("simulate", "--out", "x.csv", "--seed", "-1"),
        ("simulate", "--seed", "one"),
        ("record", "--config", "none.toml", "--seconds", "1", "--out", "x.csv"),
        ("check", "--config", "none.toml"),
        ("check",),
    ],
)
def test_json_is_one_document_also_when_it_fails(run: Run, words: tuple[str, ...]) -> None:
    result = run(*words, "--json")
    assert result.code == 2
    assert set(result.document) == {"error"} and result.document["error"]
    assert "\n" not in result.out.strip()


# -- simulate ----------------------------------------------------------------------------------------------------


def test_simulate_is_reproducible_by_seed(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["servo-daemon", "simulate"])
    files = {}
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        words = ("--seconds", "2", "--seed", seed, "--effect", "coulomb_friction", "--ageing", "R=+40%", "--json")
        result = run("simulate", "--out", "x.csv", *map(str, words))
        assert result.code == 0 and result.document["samples"] == 2000
        files[name] = Path("x.csv").read_bytes()
    assert files["a"] == files["b"] != files["c"]
    read = read_capture(tmp_path / "a" / "x.csv")
    assert len(read) == 2000 and read.channels == ("voltage_V", "current_A", "position_rad")


# -- replay ------------------------------------------------------------------------------------------------------


def replayed(run: Run, capture: Path, out: Path, *words: str | Path) -> bytes:
    result = run("replay", capture, "--out", out, *words)
    assert result.code == 0, result.err
    assert result.out == ""
    return out.read_bytes()


def test_replay_is_bit_identical_for_every_block_size(run: Run, capture: Path, tmp_path: Path) -> None:
    whole = replayed(run, capture, tmp_path / "whole.csv", "--block", "1000000")
    for block in (1, 7, 64, 1000):
        assert replayed(run, capture, tmp_path / f"{block}.csv", "--block", str(block)) == whole, block


def test_replay_is_what_the_live_pipeline_gives(run: Run, capture: Path, tmp_path: Path) -> None:
    """The same samples through the replay driver, in the blocks it delivers, as the daemon would take them."""
    whole = replayed(run, capture, tmp_path / "offline.csv")
    config = DriveConfig(name="axis1", driver="replay", options={"path": str(capture), "speed": 0})
    driver = make_driver("replay", "axis1", {"path": str(capture), "speed": 0, "block_samples": 23})
    live = tmp_path / "live.csv"
    with driver, EstimatesWriter(live, published_names(config), estimators=("ekf", "rls")) as writer:
        pipeline, blocks = Pipeline(config, driver.info), 0
        while True:
            try:
                block = driver.read(1.0)
            except EndOfStreamError:
                break
            assert block is not None
            blocks += 1
            for estimate in pipeline.process(block):
                writer.write(estimate)
        final = pipeline.finish()
        assert final is not None
        writer.write(final)
    assert blocks > 100
    assert live.read_bytes() == whole


@pytest.mark.parametrize("size", [1, 23, 170, 1100])
def test_what_the_daemon_publishes_is_a_row_of_replay(capture: Path, size: int) -> None:
    """It asks after each block, whose samples may belong to the next tick already."""
    config, block = DriveConfig(nominal=dict(PAPER_MOTOR)), read_capture(capture).block()
    info = capture_info(read_capture(capture))
    rows = {row.time_s: row.parameters for row in Pipeline(config, info).process(block)}
    live, seen = Pipeline(config, info), 0
    for a in range(0, len(block), size):
        part = block.slice(a, a + size)
        live.process(part, rows=False)
        estimate = live.current()
        assert estimate is not None and estimate.time_s == float(part.time_s[-1])
        ended = [
            t for t in rows if t < estimate.time_s and np.floor(t * 10 + 1e-6) < np.floor(estimate.time_s * 10 + 1e-6)
        ]
        if ended:
            assert estimate.parameters == rows[max(ended)]
            seen += 1
    assert seen > 2


def test_replay_depends_on_no_clock_zone_or_hash(run: Run, capture: Path, tmp_path: Path) -> None:
    here = replayed(run, capture, tmp_path / "here.csv")
    for k, changes in enumerate(
        ({"TZ": "Asia/Kathmandu", "PYTHONHASHSEED": "1"}, {"PYTHONHASHSEED": "77", "LANG": "C"})
    ):
        out = tmp_path / f"{k}.csv"
        done = run_once("replay", capture, "--out", out, env=environment(**changes))
        assert done.returncode == 0, done.stderr
        assert out.read_bytes() == here


def test_replay_without_a_clock(run: Run, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of the pipeline asks what time it is."""
    here = replayed(run, capture, tmp_path / "here.csv")
    config = DriveConfig()
    read = read_capture(capture)
    pipeline = Pipeline(config, None)

    def broken() -> float:
        raise AssertionError("the pipeline asked for the time")

    with monkeypatch.context() as patched:
        for name in ("time", "monotonic", "perf_counter"):
            patched.setattr(time, name, broken)
        estimates = [e for block in read.blocks(997) for e in pipeline.process(block)]
    with EstimatesWriter(tmp_path / "e.csv", published_names(config), estimators=("ekf", "rls")) as writer:
        for estimate in estimates:
            writer.write(estimate)
    lines = (tmp_path / "e.csv").read_bytes().splitlines()
    assert lines[0] == here.splitlines()[0] and len(lines) == len(here.splitlines()) - 1


def test_est_csv_is_as_the_contract_says(run: Run, capture: Path, tmp_path: Path) -> None:
    result = run("replay", capture, "--out", tmp_path / "e.csv", "--json")
    assert result.code == 0
    header, *rows = (tmp_path / "e.csv").read_text().splitlines()
    columns = header.split(",")
    assert columns[0] == "time_s"
    assert columns[1:16] == [f"{p}{end}" for p in LINEAR for end in ("", "_std", "_status")]
    assert {c.split("_")[0] for c in columns[16:]} == {"ekf", "rls"}
    table = [dict(zip(columns, row.split(","), strict=True)) for row in rows]
    times = [float(r["time_s"]) for r in table]
    assert np.diff(times) == pytest.approx(0.1, abs=2e-3)
    last = table[-1]
    for name in LINEAR:
        assert float(last[name]) == pytest.approx(PAPER_MOTOR[name], rel=0.05)
        assert last[f"{name}_status"] == "tracking"
        assert result.document["parameters"][name]["value"] == float(last[name])
        assert result.document["parameters"][name]["std"] == float(last[f"{name}_std"])
    assert result.document["samples"] == 6000 and result.document["rows"] == len(rows)
    assert float(last["time_s"]) == result.document["time_s"] == read_capture(capture).time_s[-1]


def test_replay_through_a_signal_map(run: Run, capture: Path, tmp_path: Path) -> None:
    """A foreign file of the same samples gives the same estimates, and its notes are shown."""
    read = read_capture(capture)
    assert read.voltage_V is not None and read.current_A is not None and read.position_rad is not None
    foreign, signals = tmp_path / "foreign.mat", tmp_path / "map.toml"
    data = np.column_stack([read.time_s, read.voltage_V, read.current_A, read.position_rad])
    savemat(foreign, {"data": data, "label": data[:, 0]})
    names = ("time_s", "voltage_V", "current_A", "position_rad")
    lines = [f'{name} = {{ signal = "data", column = {k} }}' for k, name in enumerate(names, 1)]
    cpr = f"{read.counts_per_rev:g}"
    signals.write_text("\n".join(["[signals]", *lines, "[metadata]", f"counts_per_rev = {cpr}"]))
    result = run("replay", foreign, "--signals", signals, "--out", tmp_path / "e.csv", "--json")
    assert result.code == 0, result.err
    assert f"{foreign}: signal not used: label" in result.err
    assert (tmp_path / "e.csv").read_bytes() == replayed(run, capture, tmp_path / "here.csv")
    bad = run("replay", foreign, "--signals", tmp_path / "none.toml", "--out", tmp_path / "e.csv", "--json")
    assert bad.code == 2 and "none.toml: cannot be read: No such file" in bad.document["error"]
    bad = run("replay", foreign, "--out", tmp_path / "e.csv")
    assert bad.code == 2 and len(bad.err.splitlines()) == 1 and 'time_s = { signal = "data", column = 1 }' in bad.err


def test_replay_never_writes_what_is_no_number(run: Run, tmp_path: Path, capture: Path) -> None:
    """Frozen channels, a step of a thousand volts, a gap: empty cells, never nan."""
    read = read_capture(capture)
    voltage, current = np.array(read.voltage_V), np.array(read.current_A)
    voltage[2000:2010], current[3000:4000] = 9e4, current[3000]
    time_s = read.time_s + np.where(np.arange(len(read)) >= 4500, 3.0, 0.0)
    bad = tmp_path / "bad.csv"
    write_capture(bad, make_block(time_s, voltage_V=voltage, current_A=current, position_rad=read.position_rad))
    text = replayed(run, bad, tmp_path / "e.csv").decode().lower()
    assert "nan" not in text and "inf" not in text


@pytest.mark.parametrize(
    ("channels", "nominal", "free"),
    [
        (("current_A", "position_rad"), {"K": 0.30628}, {"J", "B"}),
        (("voltage_V", "position_rad"), {"R": 0.4937, "L": 2.2769e-3, "K": 0.30628}, {"J", "B"}),
        (("voltage_V", "current_A"), {}, set()),
        (("current_A", "position_rad"), {}, set()),
        (("torque_Nm", "position_rad"), {}, {"J", "B"}),
        (("voltage_V", "current_A", "velocity_rad_s"), {}, set(LINEAR)),
    ],
)
def test_replay_of_captures_that_lack_signals(
    run: Run, capture: Path, tmp_path: Path, channels: tuple[str, ...], nominal: dict[str, float], free: set[str]
) -> None:
    read = read_capture(capture)
    position = read.position_rad
    assert position is not None and read.current_A is not None
    derived = {
        "velocity_rad_s": np.gradient(position, read.time_s),
        "torque_Nm": PAPER_MOTOR["K"] * read.current_A,
    }
    signals = {name: derived.get(name, getattr(read, name)) for name in channels}
    less = tmp_path / "less.csv"
    write_capture(less, make_block(read.time_s, **signals), metadata={"counts_per_rev": "8192"})
    config = write_config(
        tmp_path / "c.toml", "[drive.nominal]\n" + "".join(f"{k} = {v!r}\n" for k, v in nominal.items())
    )
    result = run("replay", less, "--out", tmp_path / "e.csv", "--config", config, "--json")
    assert result.code == 0, result.err
    parameters = result.document["parameters"]
    for name, p in parameters.items():
        if name in free:
            assert p["value"] is not None and p["status"] in ("tracking", "unexcited"), (name, p)
            wide = 0.3 if "velocity_rad_s" in channels else 0.1  # a numerical derivative lags
            assert p["value"] == pytest.approx(PAPER_MOTOR[name], rel=wide), name
        else:
            assert p["value"] == nominal.get(name), (name, p)
            assert p["status"] == ("fixed" if name in nominal else "estimating")
            assert p["reason"]
    text = (tmp_path / "e.csv").read_text()
    assert "nan" not in text.lower()


def test_replay_of_a_linear_axis(run: Run, tmp_path: Path) -> None:
    t = np.arange(4000) * 1e-3
    position = 0.05 * np.sin(2 * np.pi * t) + 0.02 * np.sin(2 * np.pi * 3.3 * t)
    velocity = np.gradient(position, t)
    force = 2.0 * np.gradient(velocity, t) + 5.0 * velocity
    path = tmp_path / "axis.csv"
    rows = "".join(
        f"{a!r},{b!r},{c!r}\n" for a, b, c in zip(t.tolist(), force.tolist(), position.tolist(), strict=True)
    )
    path.write_text("time_s,force_N,position_m\n" + rows)
    result = run("replay", path, "--out", tmp_path / "e.csv", "--json")
    assert result.code == 0, result.err
    assert result.document["parameters"]["J"]["unit"] == "kg"
    assert result.document["parameters"]["B"]["unit"] == "N·s/m"
    assert result.document["parameters"]["J"]["value"] == pytest.approx(2.0, rel=0.1)
    assert result.document["parameters"]["B"]["value"] == pytest.approx(5.0, rel=0.1)


def test_replay_does_not_look_at_driver_and_options(run: Run, capture: Path, tmp_path: Path) -> None:
    config = write_config(
        tmp_path / "c.toml",
        'name = "bench"\ndriver = "telepathy"\n[drive.nominal]\nR = 0.7\nJ_m = 0.0081\n[drive.options]\nspirit = 1',
        'name = "second"\n[drive.nominal]\nR = 0.6',
    )
    result = run("replay", capture, "--out", tmp_path / "e.csv", "--config", config, "--json")
    assert result.code == 0, result.err
    assert result.document["parameters"]["R"]["nominal"] == 0.7
    assert "J_d" in result.document["parameters"]
    result = run("replay", capture, "--out", tmp_path / "e.csv", "--config", config, "--drive", "second", "--json")
    assert result.document["parameters"]["R"]["nominal"] == 0.6
    result = run("replay", capture, "--out", tmp_path / "e.csv", "--config", config, "--drive", "third")
    assert result.code == 2 and "bench, second" in result.err
    bare = run("replay", capture, "--out", tmp_path / "e.csv", "--json")
    assert {p["nominal"] for p in bare.document["parameters"].values()} == {None}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "empty"),
        ("time_s,voltage_V\n0,1\n0.001,1\n", "line"),
        ("time_s,current_A,position_rad\n0,1,2\n0,1,2\n", "line 3"),
        ("time_s,current_A,position_rad\n0,1,2\n0.001,nan,2\n", "line 3"),
        ("time_s,current_A,position_rad\n0,1,2\n0.001,much,2\n", "current_A"),
    ],
)
def test_a_bad_capture_is_one_line_and_leaves_no_file(run: Run, tmp_path: Path, text: str, says: str) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text(text)
    result = run("replay", bad, "--out", tmp_path / "e.csv")
    assert result.code == 2
    assert len(result.err.splitlines()) == 1 and "bad.csv" in result.err and says in result.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.csv"]


# -- record and check --------------------------------------------------------------------------------------------


def simulated_config(tmp_path: Path, options: str) -> Path:
    return write_config(tmp_path / "c.toml", f'name = "bench"\n[drive.load]\nmass_kg = 0.5\n[drive.options]\n{options}')


def test_record_then_replay(run: Run, tmp_path: Path) -> None:
    config = simulated_config(tmp_path, "realtime = false\nseed = 3")
    out = tmp_path / "r.csv.gz"
    result = run("record", "--config", config, "--seconds", "5", "--out", out, "--json")
    assert result.code == 0, result.err
    assert result.document == {"capture": str(out), "samples": 5000, "samples_lost": 0}
    text = gzip.decompress(out.read_bytes()).decode()
    assert "# drive: bench\n" in text and "# mass_kg: 0.5\n" in text and "# identity: simulated-" in text
    replayed_ = run("replay", out, "--out", tmp_path / "e.csv", "--json")
    assert replayed_.code == 0
    for name in LINEAR:
        assert replayed_.document["parameters"][name]["value"] == pytest.approx(PAPER_MOTOR[name], rel=0.05)


def test_record_of_a_source_that_ends_keeps_what_there_was(run: Run, tmp_path: Path) -> None:
    config = simulated_config(tmp_path, "realtime = false\nduration_s = 1.5")
    result = run("record", "--config", config, "--seconds", "5", "--out", tmp_path / "r.csv", "--json")
    assert result.code == 0 and result.document["samples"] == 1500
    assert len(read_capture(tmp_path / "r.csv")) == 1500


def test_record_of_a_device_that_goes_away_fails_and_keeps_what_there_was(run: Run, tmp_path: Path) -> None:
    config = simulated_config(tmp_path, "realtime = false\nfail_after_s = 1.5")
    result = run("record", "--config", config, "--seconds", "5", "--out", tmp_path / "r.csv", "--json")
    assert result.code == 1
    assert "went away" in result.document["error"] and "1,500 samples" in result.document["error"]
    assert len(read_capture(tmp_path / "r.csv")) == 1500


@pytest.mark.first_is_fast
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP], ids=lambda n: n.name)
def test_record_that_is_stopped_keeps_what_there_was(tmp_path: Path, number: signal.Signals) -> None:
    config = simulated_config(tmp_path, "seed = 3")
    out = tmp_path / "r.csv"
    program = Program("record", "--config", config, "--seconds", "1000", "--out", out)
    try:

        def growing() -> bool:
            return any(p.stat().st_size > 50_000 for p in tmp_path.glob(".r.csv.*"))

        wait_for(growing, "a second or so is recorded")
        program.send(number)
        assert program.wait() == 0, program.log
        assert program.said("stopped early; what was recorded is kept") == 1
        assert len(read_capture(out)) > 500
        assert sorted(p.name for p in tmp_path.iterdir()) == ["c.toml", "r.csv"]
    finally:
        program.end()


def test_record_stopped_before_the_first_sample_leaves_nothing(tmp_path: Path) -> None:
    master, slave = os.openpty()
    config = write_config(tmp_path / "c.toml", f'driver = "serial"\n[drive.options]\nport = "{os.ttyname(slave)}"')
    program = Program("record", "--config", config, "--seconds", "10", "--out", tmp_path / "r.csv")
    try:
        port = Path(os.ttyname(slave))

        def open_there() -> bool:
            links = Path(f"/proc/{program.process.pid}/fd").iterdir()
            with_port = [link for link in links if link.is_symlink() and _target(link) == str(port)]
            return bool(with_port)

        wait_for(open_there, "it has opened the port")
        program.send(signal.SIGTERM)
        assert program.wait() == 1
        assert program.said("stopped before the first sample") == 1
        assert sorted(p.name for p in tmp_path.iterdir()) == ["c.toml"]
    finally:
        program.end()
        os.close(master)
        os.close(slave)


def _target(link: Path) -> str:
    try:
        return str(link.readlink())
    except OSError:  # closed meanwhile
        return ""


def test_record_from_a_missing_port_fails(run: Run, tmp_path: Path) -> None:
    config = write_config(tmp_path / "c.toml", f'driver = "serial"\n[drive.options]\nport = "{tmp_path}/none"')
    result = run("record", "--config", config, "--seconds", "1", "--out", tmp_path / "r.csv", "--json")
    assert result.code == 1 and "does not exist" in result.document["error"]
    assert not (tmp_path / "r.csv").exists()


def test_check_says_what_it_sees(run: Run, tmp_path: Path) -> None:
    config = write_config(
        tmp_path / "c.toml",
        'name = "one"\n[drive.options]\nrealtime = false\nduration_s = 1.0',
        'name = "two"\n[drive.nominal]\nK = 0.3\n[drive.options]\nrealtime = false\nduration_s = 1.0\n'
        'sensors = { channels = ["current_A", "position_rad"] }',
    )
    result = run("check", "--config", config, "--listen", "5", "--json")
    assert result.code == 0, result.err
    one, two = result.document["drives"]
    assert one["problem"] is None and one["samples"] == 1000 and one["samples_lost"] == 0
    assert one["sample_rate_hz"] == pytest.approx(1000, rel=0.01)
    assert one["channels"] == ["voltage_V", "current_A", "position_rad"] and one["estimated"] == list(LINEAR)
    assert two["estimated"] == ["J", "B"] and set(two["not_estimated"]) == {"R", "L", "K"}
    text = run("check", "--config", config, "--listen", "5")
    assert text.code == 0
    assert "one (simulated): " in text.out and "1000.0 samples a second" in text.out
    assert "  estimated: J, B" in text.out


def test_check_of_a_drive_that_is_not_there_or_says_nothing(run: Run, tmp_path: Path) -> None:
    master, slave = os.openpty()
    try:
        config = write_config(
            tmp_path / "c.toml",
            f'name = "gone"\ndriver = "serial"\n[drive.options]\nport = "{tmp_path}/none"',
            f'name = "mute"\ndriver = "serial"\n[drive.options]\nport = "{os.ttyname(slave)}"',
            'name = "well"\n[drive.options]\nrealtime = false\nduration_s = 1.0',
        )
        result = run("check", "--config", config, "--listen", "0.3", "--json")
    finally:
        os.close(master)
        os.close(slave)
    assert result.code == 1
    gone, mute, well = result.document["drives"]
    assert "does not exist" in gone["problem"]
    assert "no samples in 0.3 s (0 framing errors)" in mute["problem"]
    assert well["problem"] is None and well["samples"] == 1000


def test_check_hears_a_simulated_device(run: Run, tmp_path: Path) -> None:
    link = tmp_path / "servo0"
    config = write_config(tmp_path / "c.toml", f'driver = "serial"\n[drive.options]\nport = "{link}"')
    with sim_drive("serial", link):
        result = run("check", "--config", config, "--listen", "2.5", "--json")
    assert result.code == 0, result.err
    (drive,) = result.document["drives"]
    assert drive["identity"].startswith("simulated-") and drive["counts_per_rev"] == 8192
    assert drive["crc_errors"] == drive["samples_lost"] == 0


def test_a_reader_of_our_output_that_goes_away_is_no_crash(capture: Path, tmp_path: Path) -> None:
    """As `servo-daemon check | head -0` does."""
    config = write_config(tmp_path / "c.toml", "[drive.options]\nrealtime = false\nduration_s = 1.0")
    program = subprocess.Popen(
        [sys.executable, "-m", "servo_daemon", "check", "--config", config, "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment(), text=True,
        cwd=Path(__file__).resolve().parents[3],
    )  # fmt: skip
    assert program.stdout is not None and program.stderr is not None
    program.stdout.close()
    errors = program.stderr.read()
    program.stderr.close()
    assert program.wait(60) == 1
    assert "Traceback" not in errors


def test_what_is_read_is_not_written_over(run: Run, capture: Path, tmp_path: Path) -> None:
    """A capture cannot be measured again."""
    config = tmp_path / "servo.toml"
    config.write_text("[[drive]]\nname = 'a'\n[drive.nominal]\nR=1\nL=1e-3\nK=0.1\nJ=1e-3\nB=1e-2\n")
    link = tmp_path / "link.csv"
    link.symlink_to(capture)
    before = capture.read_bytes()
    for words in (
        ("replay", capture, "--out", capture),
        ("replay", capture, "--out", link),
        ("replay", capture, "--config", config, "--out", config),
        ("excite", "--config", config, "--diagnosis", capture, "--out", capture),
        ("train", "--config", config, "--motors", "1", "--out", config),
    ):
        result = run(*words)
        assert result.code == 2 and "which is read: choose another name" in result.err
    assert capture.read_bytes() == before and config.read_text().startswith("[[drive]]")


def test_a_configuration_without_a_drive_runs_nothing(run: Run, tmp_path: Path) -> None:
    config = tmp_path / "servo.toml"
    config.write_text("[api]\nport = 0\n")
    for words in (("check", "--json"), ("record", "--seconds", "0.1", "--out", tmp_path / "r.csv")):
        result = run(*words, "--config", config)
        assert result.code == 2 and "servo.toml: no [[drive]]: add that line" in result.err
        assert "--json" not in words or "no [[drive]]" in json.loads(result.out)["error"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("simulate", "--out", "s.csv", "--seconds", "0.001"), "1 sample: a capture has at least 2"),
        (("sim-drive", "--serial", "link", "--drive-id", "-1"), "--drive-id -1 is outside 0 .. 255"),
        (("sim-drive", "--serial", "link", "--drive-id", "256"), "--drive-id 256 is outside 0 .. 255"),
        (("sim-drive", "--slcan", "link", "--drive-id", "32"), "--drive-id 32 is outside 1 .. 31"),
        (("sim-drive", "--serial", "link", "--seconds", "-1"), "--seconds: must be a number greater than zero, not -1"),
        (
            ("sim-drive", "--serial", "link", "--seconds", "nan"),
            "--seconds: must be a number greater than zero",
        ),
        (("check", "--config", "c.toml", "--listen", "nan"), "--listen: must be a number greater than zero, not nan"),
        (("check", "--config", "c.toml", "--listen", "0"), "--listen: must be a number greater than zero, not 0"),
        (("check", "--config", "c.toml"), "drive a: unknown driver 'tacho'"),
        (("train", "--jobs", "0"), "--jobs must not be 0"),
        (("train", "--seed", "-1"), "--seed must not be negative"),
        (("train", "--rate", "x"), "--rate: must be a number greater than zero, not x"),
        (("train", "--motors", "1", "--out", "."), "--out .: is a folder"),
        (("train", "--motors", "1", "--out", "c.toml/model"), "--out c.toml: "),
    ],
)
def test_what_cannot_be_is_refused_at_once(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("c.toml").write_text("[[drive]]\nname = 'a'\ndriver = 'tacho'\n")
    result = run(*words)
    *usage, line = result.err.strip().splitlines()
    assert result.code == 2 and says in line and (not usage or usage[0].startswith("usage: ")), result.err
    assert [p.name for p in tmp_path.iterdir()] == ["c.toml"]
