"""Every row of the table in docs/drives.md as it stands there: a simulated drive on its wire, `scan`, `check`, and a
daemon whose REST API is read. Of the configuration only the port is another."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.sim_drive.makes.catalogue import ACTUATOR
from servo_daemon.sim_drive.makes.foc import Pmsm
from servo_daemon.sim_drive.makes.odrive import ENDPOINTS
from servo_daemon.simulate.settings import PAPER_MOTOR
from tests.system.harness import ROOT, Program, daemon, run_once, wait_for, write_config

#: A wire is looked at so often at most. On a busy machine one look takes so long, s, and so long it takes until the
#: values are known.
TRIES, BUSY_S = 3, 150.0
MOTOR = Pmsm()
PHASE = {"R": MOTOR.R, "K": MOTOR.K_phase, "J": MOTOR.J, "B": MOTOR.B}
KT = PHASE | {"R": 1.5 * MOTOR.R, "K": MOTOR.Kt}


@dataclass(frozen=True)
class Case:
    """How a row is tried.

    Attributes:
        words: of `sim-drive`, before the link.
        truth: of its motor, as it is published.
        known: parameters that are tracked soon; the others of the row are right where they are.
        timing: the rate of reads, where the row's own is too slow for this motor; the period of what comes by itself.
        nominal: what the row asks its user to give.
        more_words: of `sim-drive`, after the link.
    """

    words: tuple[str, ...]
    truth: Mapping[str, float]
    known: str
    timing: str = ""
    nominal: str = ""
    more_words: tuple[str, ...] = ()


#: What takes a core for half a minute, and is no part of a row.
_NOTHING_BESIDE = '[drive.estimation]\ndiagnose = "never"\nrefresh = false'
_STILL = ("--ageing", "R=+0%/1h")
CASES = {
    "VESC, USB or UART": Case(("--vesc",), PHASE, "RK"),
    "VESC, CAN": Case(("--vesc-can",), PHASE, "RKJ"),
    "ODrive, CAN": Case(("--odrive", "0.6"), KT, "J"),
    "ODrive 0.6, CAN, asked": Case(("--odrive", "0.6"), KT, "RK", more_words=("--drive-id", "0")),
    # Questions come too unevenly from a busy machine to tell J and B from 100 Hz.
    "ODrive 0.5, USB": Case(("--odrive-text",), KT, "", nominal=f"[drive.nominal]\nK = {MOTOR.Kt!r}"),
    "moteus": Case(("--moteus",), KT, "J"),
    "Dynamixel X": Case(("--dynamixel",), PAPER_MOTOR, "RK", timing="rate_hz = 500.0", more_words=_STILL),
    # Steps of 6.5 mA at times that are known to half a millisecond: K is often open, and never wrong.
    "Feetech STS": Case(("--feetech",), PAPER_MOTOR, "", timing="rate_hz = 500.0", more_words=_STILL),
    "SimpleFOC": Case(("--simplefoc",), PHASE, "RKJ", timing="period_s = 2e-3"),
    "CANopen, CiA 402": Case(("--cia402",), PHASE, "J", timing="period_s = 2e-3", more_words=("--drive-id", "5")),
    "CubeMars AK, Damiao, RobStride": Case(
        ("--mit",), {"J": ACTUATOR.J, "B": ACTUATOR.B}, "J", timing="period_s = 2e-3"
    ),
}


def rows() -> dict[str, tuple[str, str]]:
    """Of each drive in the table: what can be known, and its TOML."""
    text = (ROOT / "docs" / "drives.md").read_text(encoding="utf-8")
    below = {re.search(r"# (\w+)", block)[1]: block for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL)}  # type: ignore[index]
    found = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) != 5 or "`driver = " not in cells[4]:
            continue
        toml = "\n".join(re.findall(r"`([^`]+)`", cells[4]))
        if cells[4].endswith("see below"):
            driver = tomllib.loads(toml.partition("[drive.options]")[0])["driver"]
            toml = toml.replace("[drive.options]", below[driver])
        found[cells[0]] = cells[3], toml
    return found


ROWS = rows()


def test_every_row_is_tried() -> None:
    assert set(ROWS) == set(CASES)
    for drive, (can_be_known, _) in ROWS.items():
        assert all(re.search(rf"\b{name}\b", can_be_known) for name in CASES[drive].known) or "as " in can_be_known


def placed(toml: str, link: Path, endpoints: Path) -> str:
    """A row's TOML on a simulated drive: the port is the link, a bus the one behind the adapter there."""
    toml = re.sub(r'(port|channel) = ".*?"', rf'\1 = "{link}"', toml)
    toml = re.sub(r'endpoints = ".*?"', f'endpoints = "{endpoints}"', toml)
    return toml.replace('interface = "socketcan"', 'interface = "slcan"')


def heard(look: Callable[[], dict[str, Any] | None]) -> dict[str, Any]:
    """What a command finds; a busy machine may not hear a drive within the seconds of one look."""
    for _ in range(TRIES):
        if found := look():
            return found
    raise AssertionError("not found")


def scan(toml: str, link: Path) -> dict[str, Any] | None:
    where = ("--can", f"slcan:{link}") if "slcan" in toml else ("--port", str(link))
    said = run_once("scan", "--json", "--ask", "--seconds", "2", *where, within_s=BUSY_S)
    assert said.stdout, said.stderr
    return next(iter(json.loads(said.stdout)["drives"]), None)


def check(config: Path) -> dict[str, Any] | None:
    said = run_once("check", "--json", "--listen", "2", "--config", config, within_s=BUSY_S)
    assert said.stdout, said.stderr
    return next((r for r in json.loads(said.stdout)["drives"] if r["samples"]), None)


def is_asked_late(document: Mapping[str, Any]) -> bool:
    """Whether this machine is too busy to ask in time: then nothing need be known, and what is must be right."""
    health = document["health"]
    return bool(document["samples"] > 2000 and health.get("polls_missed", 0) > 0.05 * health.get("polls_sent", 0))


def is_near(document: Mapping[str, Any], name: str, true: float) -> bool:
    """Whether it is tracked and within 10 %: at the first look its interval may be wide."""
    p = document["parameters"][name]
    return bool(p["status"] == "tracking" and abs(p["value"] / true - 1.0) < 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("drive", CASES)
def test_a_row_is_true(drive: str, tmp_path: Path) -> None:
    case, link, endpoints = CASES[drive], tmp_path / "drive", tmp_path / "flat_endpoints.json"
    table = {name: {"id": number, "type": "float"} for name, number in ENDPOINTS.items()}
    endpoints.write_text(json.dumps({"fw_version": "0.6.10-1", "hw_version": "4.4.58", "endpoints": table}))
    toml = f"{placed(ROWS[drive][1], link, endpoints)}\n{case.timing}\n{case.nominal}\n{_NOTHING_BESIDE}"
    config = write_config(tmp_path / "c.toml", f'name = "axis1"\n{toml}')

    def known(document: Mapping[str, Any]) -> bool:
        near = all(is_near(document, name, case.truth[name]) for name in case.known)
        return document["samples"] > 100 and (near or is_asked_late(document))

    with ExitStack() as stack:
        simulated = Program("sim-drive", *case.words, link, *case.more_words)
        stack.callback(simulated.end)
        wait_for(link.is_symlink, f"{link} appears")
        found, report = heard(lambda: scan(toml, link)), heard(lambda: check(config))
        assert found["driver"] == report["driver"] == tomllib.loads(ROWS[drive][1])["driver"]
        assert set(case.known) <= set(report["estimated"]) and report["remarks"] == []
        program = stack.enter_context(daemon("--config", config, "--state-dir", tmp_path / "state"))
        shown = program.until(known, f"{drive}: {case.known}", limit_s=BUSY_S)
    assert shown["health"]["connection"] == "connected"
    for name, true in case.truth.items():
        p = shown["parameters"][name]
        if p["status"] == "tracking":
            assert abs(p["value"] - true) <= max(4.0 * p["std"], 0.03 * true), (name, p["value"] / true, p["std"])
