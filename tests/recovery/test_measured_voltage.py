"""Drives whose voltage is a measurement, as VESC, moteus and SimpleFOC tell it: values and their standard deviations
against the truth of a motor under field-oriented control that shares nothing with the plant."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.cli import main
from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.published.snapshot import Estimate
from servo_daemon.samples import make_block
from servo_daemon.signal_meaning import SignalMeaning
from tests.recovery.foc.motor import OUTRUNNER, SMALL, Trace, instants, multisine, pick_and_place, polled, run

#: The issue's limits, % of R, K, J and B.
MEANS, INSTANTS = (1.0, 1.0, 3.0, 3.0), (2.0, 2.0, 3.0, 5.0)
#: Of a normal error one in 16,000 is larger.
FAR = 4.0
TRUE = OUTRUNNER.equivalent("phase") | {"L": OUTRUNNER.L}


@cache
def outrunner(motion: str) -> Trace:
    speed = multisine(40.0) if motion == "multisine" else pick_and_place(60.0)
    return run(OUTRUNNER, speed, 6.0, noise_A=0.05)


@cache
def small() -> Trace:
    return run(SMALL, multisine(30.0), 6.0, noise_A=0.003)


def sampled(trace: Trace, kind: str, hz: float) -> dict[str, np.ndarray]:
    return polled(trace, hz) if kind == "mean" else instants(trace, hz)


def fitted(folder: Path, capsys: pytest.CaptureFixture[str], columns: dict[str, np.ndarray], *lines: str) -> dict:
    path = folder / "link.csv"
    head = "".join(f"# {line}\n" for line in lines)
    rows = "\n".join(",".join(f"{x:.9g}" for x in row) for row in np.column_stack(list(columns.values())))
    path.write_text(f"{head}{','.join(columns)}\n{rows}\n", encoding="utf-8")
    assert main(["fit", str(path), "--json"]) == 0
    found: dict = json.loads(capsys.readouterr().out)
    return found


def check(parameters: dict, limits: tuple[float, ...], true: dict[str, float] = TRUE) -> None:
    for name, limit in zip(("R", "K", "J", "B"), limits, strict=True):
        value, std = parameters[name]["value"], parameters[name]["std"]
        off = value / true[name] - 1.0
        assert abs(off) < limit / 100.0, (name, off)
        assert abs(off) * true[name] < FAR * std, (name, off, std / value)
        assert std < 3.0 * limit / 100.0 * value  # and it is claimed


@pytest.mark.parametrize("motion", ["multisine", "pick and place"])
@pytest.mark.parametrize(
    ("kind", "hz"), [("mean", 20), ("mean", 100), ("mean", 500), ("instant", 200), ("instant", 1000)]
)
def test_fit_knows_the_motor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], motion: str, kind: str, hz: float
) -> None:
    lines = f"voltage: {kind}", f"current: {kind}", "convention: dq", "pole_pairs: 7"
    document = fitted(tmp_path, capsys, sampled(outrunner(motion), kind, hz), *lines)
    check(document["parameters"], MEANS if kind == "mean" else INSTANTS)
    L = document["parameters"]["L"]
    if L["value"] is not None:
        assert abs(L["value"] - TRUE["L"]) < FAR * L["std"]
    if kind == "instant":
        assert L["value"] is None and L["status"] == "undetermined"  # the winding settles between two samples
    line = document["equivalents"]["line"]
    assert line["R"]["value"] == pytest.approx(2 * document["parameters"]["R"]["value"])
    correlation = document["correlation"]
    assert set(correlation) >= {"R", "K", "J", "B"}
    assert np.linalg.eigvalsh([[correlation[a][b] for b in correlation] for a in correlation])[0] > -1e-9


def test_taken_for_a_held_voltage_the_same_file_gives_another_motor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What the lines are for: without them it is a voltage written a row late, which is left out and names them."""
    columns = sampled(outrunner("multisine"), "mean", 50)
    document = fitted(tmp_path, capsys, columns, "convention: dq")
    R = document["parameters"].get("R", {"value": None})["value"]
    assert R is None or abs(R / TRUE["R"] - 1.0) > 0.2
    assert R is not None or any("# voltage: mean" in note for note in document["notes"])


def test_coarse_steps_of_a_small_motors_current(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = "voltage: mean", "current: mean", "convention: dq", "publish: kt", "pole_pairs: 7"
    document = fitted(tmp_path, capsys, sampled(small(), "mean", 200), *lines)
    check(document["parameters"], (5.0, 1.0, 3.0, 3.0), SMALL.equivalent("kt"))


def test_rounding_that_repeats_is_in_the_standard_deviations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At constant speed a small motor's current is some five steps, and reads the same for half a second."""
    trace = run(SMALL, pick_and_place(45.0), 6.0, noise_A=0.003)
    head = ("voltage: mean", "current: mean", "convention: dq")
    B = fitted(tmp_path, capsys, polled(trace, 500), *head)["parameters"]["B"]
    off = abs(B["value"] / SMALL.B - 1.0)
    assert off < 1.96 * B["std"] / B["value"] < 0.2, (off, B["std"] / B["value"])


def test_a_voltage_against_the_currents_direction_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Dead time that the drive has not taken out of its voltage: R is less sure, or the model has it."""
    columns = sampled(outrunner("multisine"), "mean", 200)
    columns["voltage_V"] = columns["voltage_V"] + 0.05 * np.sign(columns["current_A"])
    lines = "voltage: mean", "current: mean", "convention: dq", "pole_pairs: 7"
    document = fitted(tmp_path, capsys, columns, *lines)
    R = document["parameters"]["R"]
    assert abs(R["value"] - TRUE["R"]) > 0.02 * TRUE["R"]
    assert abs(R["value"] - TRUE["R"]) < FAR * R["std"]
    assert any("current's direction" in note for note in document["notes"])


def live(trace: Trace, kind: str, hz: float) -> Estimate:
    meaning = SignalMeaning(kind, kind if kind == "mean" else "instant", "dq", pole_pairs=7)
    columns = sampled(trace, kind, hz)
    pipeline = Pipeline(DriveConfig(), meaning=meaning)
    pipeline.process(make_block(columns.pop("time_s"), **columns), rows=False)
    last = pipeline.finish() or pipeline.current()
    assert last is not None
    return last


@pytest.mark.parametrize(("kind", "hz"), [("mean", 500), ("mean", 200), ("instant", 1000)])
def test_the_daemon_knows_the_motor(kind: str, hz: float) -> None:
    estimate = live(outrunner("pick and place"), kind, hz)
    found = {p.name: p for p in estimate.parameters}
    for name, limit in zip(("R", "K", "J", "B"), INSTANTS, strict=True):
        p = found[name]
        assert p.status == "tracking" and p.value is not None and p.std is not None, (name, p)
        assert abs(p.value / TRUE[name] - 1.0) < limit / 100.0, name
        assert abs(p.value - TRUE[name]) < FAR * p.std, name
    assert estimate.covariance is not None
    at = [estimate.covariance.names.index(n) for n in ("R", "K", "J", "B")]
    variances = np.diag(np.array(estimate.covariance.values))[at]
    stds = [(found[n].std or 0.0) / (found[n].value or 1.0) for n in ("R", "K", "J", "B")]
    assert np.sqrt(variances) == pytest.approx(stds, rel=1e-6)
    assert np.linalg.eigvalsh(np.array(estimate.covariance.values))[0] > 0.0
    kt = estimate.equivalents["kt"]["K"][0]
    assert kt is not None and math.isclose(kt, 1.5 * 7 * OUTRUNNER.flux, rel_tol=0.01)


@pytest.mark.parametrize("motion", ["multisine", "pick and place"])
@pytest.mark.parametrize(("kind", "hz"), [("instant", 50), ("instant", 20), ("mean", 20)])
def test_a_slow_link_says_nothing_wrong_for_sure(motion: str, kind: str, hz: float) -> None:
    for p in live(outrunner(motion), kind, hz).parameters:
        if p.status == "tracking" and p.value is not None and p.std is not None:
            off = abs(p.value - TRUE[p.name])
            assert off < max(FAR * p.std, 0.03 * TRUE[p.name]), (p.name, p.value / TRUE[p.name] - 1.0, p.std / p.value)
        elif p.status == "estimating":
            assert p.reason


def test_the_blocks_do_not_matter() -> None:
    columns = sampled(outrunner("pick and place"), "mean", 200)
    meaning = SignalMeaning("mean", "mean", "dq")
    block = make_block(columns.pop("time_s"), **columns)
    whole, pieces = (Pipeline(DriveConfig(), meaning=meaning) for _ in range(2))
    a = whole.process(block)
    b = [e for k in range(0, len(block), 7) for e in pieces.process(block.slice(k, min(k + 7, len(block))))]
    assert [e.parameters for e in a] == [e.parameters for e in b]


def test_before_its_balance_tells_the_reason_names_the_link() -> None:
    columns = {name: x[:100] for name, x in sampled(outrunner("multisine"), "instant", 50).items()}
    pipeline = Pipeline(DriveConfig(), meaning=SignalMeaning("instant", convention="dq"))
    pipeline.process(make_block(columns.pop("time_s"), **columns).slice(0, 60), rows=False)
    last = pipeline.current()
    assert last is not None
    R = next(p for p in last.parameters if p.name == "R")
    assert R.status == "estimating" and R.reason is not None and "an instant's at 50 Hz" in R.reason
