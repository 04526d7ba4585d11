"""`scan`: what it finds on ports and buses, what it says of it, and that only reads leave."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from drivers.base import DriverCounters
from drivers.odrive.asking import MAY_SEND as ODRIVE_MAY_SEND
from drivers.vesc.packets import PacketReader
from drivers.vesc.requests import MAY_SEND as VESC_MAY_SEND
from servo_daemon.cli import main
from servo_daemon.config import parse_config
from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
from servo_daemon.sim_drive.makes.foc import FocDrive, RunningFoc
from servo_daemon.sim_drive.makes.odrive import OdriveNode, OdriveText
from servo_daemon.sim_drive.makes.serve import Device
from servo_daemon.sim_drive.makes.vesc import VescDevice, VescNode
from tests.can_tools import slcan_drive
from tests.drivers.makes.rig import Silent, line


def motor() -> RunningFoc:
    return RunningFoc(FocDrive())


def scan(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = main(["scan", "--json", *words])
    return code, json.loads(capsys.readouterr().out)


def only_drive(document: dict[str, Any]) -> dict[str, Any]:
    (drive,) = document["drives"]
    config = parse_config(tomllib.loads(drive["toml"]))  # what is printed is a configuration
    assert config.drive[0].driver == drive["driver"]
    return drive  # type: ignore[no-any-return]


def test_a_vesc_on_a_port_is_found_by_asking_and_with_reads_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = tmp_path / "vesc"
    with line(port, VescDevice(motor())) as rig:
        code, document = scan(capsys, "--port", str(port), "--ask", "--seconds", "2")
        sent = PacketReader(DriverCounters()).feed(bytes(rig.heard))
    drive = only_drive(document)
    assert code == 0 and drive["driver"] == "vesc"
    assert drive["options"] == {"port": str(port), "position": "encoder"}
    assert {"R", "K", "J", "B"} <= set(drive["determined"])
    assert set(sent) == {payload for payloads in VESC_MAY_SEND.values() for payload in payloads}


def test_without_ask_nothing_is_sent_and_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = tmp_path / "vesc"
    with line(port, VescDevice(motor())) as rig:
        code, document = scan(capsys, "--port", str(port), "--seconds", "0.5")
        assert bytes(rig.heard) == b""
    assert code == 1 and document["drives"] == []
    assert "--ask" in document["remarks"][0] and str(port) in document["remarks"][0]


def test_an_odrive_on_a_port_is_found_with_reads_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = tmp_path / "odrive"
    with line(port, OdriveText(motor())) as rig:
        _, document = scan(capsys, "--port", str(port), "--ask", "--seconds", "1")
        heard = bytes(rig.heard)
    assert only_drive(document)["driver"] == "odrive"
    hello = b"\x02\x01\x00\x00\x00\x03"  # a VESC is asked for its firmware first
    assert heard.replace(hello, b"").replace(ODRIVE_MAY_SEND[0], b"") == b""


@pytest.mark.first_is_fast
@pytest.mark.parametrize(
    ("node", "driver", "option", "signals"),
    [
        (lambda: VescNode(motor(), vesc_id=9), "vesc", {"can_id": 9}, {"voltage_V", "current_A", "position_rad"}),
        (lambda: OdriveNode(motor(), node_id=8), "odrive", {"node_id": 8}, {"position_rad", "torque_Nm"}),
    ],
)
def test_what_is_heard_on_a_bus(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    node: Any,
    driver: str,
    option: dict[str, int],
    signals: set[str],
) -> None:
    bus = SlcanBus(node())
    with line(tmp_path / "can0", bus):
        code, document = scan(capsys, "--can", f"slcan:{tmp_path / 'can0'}", "--seconds", "4")
    drive = only_drive(document)
    assert code == 0 and drive["driver"] == driver
    assert drive["options"] == {"interface": "slcan", "channel": str(tmp_path / "can0")} | option
    assert signals <= set(drive["channels"])
    assert ("R" in drive["undetermined"]) == (driver == "odrive")
    assert bus.heard == []


def test_our_own_frames_are_no_odrives(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with slcan_drive(tmp_path / "can0"):
        _, document = scan(capsys, "--can", f"slcan:{tmp_path / 'can0'}", "--seconds", "2")
    assert only_drive(document)["driver"] == "can"


def test_a_silent_bus_and_a_missing_port_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    silent: Device = Silent()
    with line(tmp_path / "can0", silent):
        code, document = scan(
            capsys, "--can", f"slcan:{tmp_path / 'can0'}", "--port", str(tmp_path / "none"), "--seconds", "0.5"
        )
    assert code == 1
    assert any("does not exist" in remark for remark in document["remarks"])
    assert any("slcan" in remark for remark in document["remarks"])


@pytest.mark.parametrize("words", [("--can", "can0"), ("--seconds", "0"), ("--can", "nothing:x")])
def test_bad_flags_are_refused(words: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scan", *words]) == 2
    assert words[1].replace(":", " ") in capsys.readouterr().err.replace(":", " ")
