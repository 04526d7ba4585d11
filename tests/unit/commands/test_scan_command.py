"""`scan`: what it finds on ports and buses, what it says of it, and that only reads leave."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from drivers.base import DriverCounters
from drivers.cia402.drive import may_send as cia402_may_send
from drivers.cia402.identity import IDENTITY
from drivers.cia402.objects import STANDARD
from drivers.odrive.asking import MAY_SEND as ODRIVE_MAY_SEND
from drivers.odrive.asking import TORQUE_CONSTANT
from drivers.servo_bus.families import DynamixelX, FeetechSts
from drivers.vesc.packets import PacketReader
from drivers.vesc.requests import MAY_SEND as VESC_MAY_SEND
from servo_daemon.cli import main
from servo_daemon.commands.scan.asking import servos_on
from servo_daemon.commands.scan.presets import _odrive
from servo_daemon.config import parse_config
from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
from servo_daemon.sim_drive.makes.cia402 import Cia402Node
from servo_daemon.sim_drive.makes.foc import FocDrive, RunningFoc
from servo_daemon.sim_drive.makes.mit import MitActuator
from servo_daemon.sim_drive.makes.moteus import Fdcanusb, Moteus
from servo_daemon.sim_drive.makes.odrive import OdriveNode, OdriveText
from servo_daemon.sim_drive.makes.serve import Device
from servo_daemon.sim_drive.makes.servos import DynamixelChain, FeetechChain
from servo_daemon.sim_drive.makes.simplefoc import SimpleFocMonitor
from servo_daemon.sim_drive.makes.vesc import VescDevice, VescNode
from tests.can_tools import slcan_drive
from tests.drivers.makes.rig import Silent, line, sine_motor


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
        code, document = scan(capsys, "--port", str(port), "--ask", "--seconds", "1.5")
        sent = PacketReader(DriverCounters()).feed(bytes(rig.heard))
    drive = only_drive(document)
    assert code == 0 and drive["driver"] == "vesc"
    assert drive["options"] == {"port": str(port), "position": "encoder"}
    assert {"R", "K", "J", "B"} <= set(drive["determined"])
    told, true = parse_config(tomllib.loads(drive["toml"])).drive[0].nominal, FocDrive().motor
    assert told == pytest.approx({"R": true.R, "L": true.L, "K": true.K_phase}, rel=1e-5)
    assert set(sent) == {payload for payloads in VESC_MAY_SEND.values() for payload in payloads}


def test_without_ask_nothing_is_sent_and_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = tmp_path / "vesc"
    with line(port, VescDevice(motor())) as rig:
        code, document = scan(capsys, "--port", str(port), "--seconds", "0.5")
        assert bytes(rig.heard) == b""
    assert code == 1 and document["drives"] == []
    assert "--ask" in document["remarks"][0] and str(port) in document["remarks"][0]


@pytest.mark.slow
def test_an_odrive_on_a_port_is_found_with_reads_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = tmp_path / "odrive"
    with line(port, OdriveText(motor())) as rig:
        _, document = scan(capsys, "--port", str(port), "--ask", "--seconds", "2")
        heard = bytes(rig.heard)
    drive = only_drive(document)
    assert drive["driver"] == "odrive" and {"J", "B"} <= set(drive["determined"])
    assert drive["nominal"] == {"K": pytest.approx(FocDrive().motor.Kt, rel=1e-4)}
    hello = b"\x02\x01\x00\x00\x00\x03"  # a VESC is asked for its firmware first
    assert heard.replace(hello, b"").replace(ODRIVE_MAY_SEND[0], b"").replace(TORQUE_CONSTANT[0], b"") == b""


@pytest.mark.slow
def test_every_servo_of_a_chain_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chain = DynamixelChain({3: sine_motor(0.01), 17: sine_motor(0.01)})
    with line(tmp_path / "chain", chain):
        code, document = scan(capsys, "--port", str(tmp_path / "chain"), "--ask", "--seconds", "0.5")
    assert code == 0
    assert [(d["driver"], d["options"]["drive_id"]) for d in document["drives"]] == [
        ("dynamixel", 3),
        ("dynamixel", 17),
    ]
    assert all({"R", "K", "J", "B"} <= set(d["determined"]) for d in document["drives"])
    assert all("between samples" in d["undetermined"]["L"] for d in document["drives"])


def test_servos_are_looked_for_with_reads_only(tmp_path: Path) -> None:
    for family, chain in ((DynamixelX(fast=True), DynamixelChain), (FeetechSts(), FeetechChain)):
        with line(tmp_path / chain.__name__, chain({1: sine_motor(0.01), 9: sine_motor(0.01)})) as rig:
            assert servos_on(str(rig.link), 1_000_000, family) == [1, 9]
        assert bytes(rig.heard) == b"".join(family.search)


def test_a_moteus_is_found_by_its_number(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = Moteus(sine_motor(0.001), torque_constant=0.1, drive_id=5)
    with line(tmp_path / "fdcanusb", Fdcanusb(drive)) as rig:
        _, document = scan(capsys, "--port", str(rig.link), "--ask", "--seconds", "0.5")
    found = only_drive(document)
    assert (found["driver"], found["options"]["drive_id"]) == ("moteus", 5)
    assert {"J", "B"} <= set(found["determined"]) and "R" in found["undetermined"]


@pytest.mark.parametrize("monitor", ["1111111", "1100011"])
def test_a_simplefoc_monitor_is_found_without_asking(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monitor: str
) -> None:
    """All seven columns say what they are; of four only the sketch knows which."""
    with line(tmp_path / "foc", SimpleFocMonitor(sine_motor(0.01), monitor=monitor, period_s=0.01)) as rig:
        _, document = scan(capsys, "--port", str(rig.link), "--seconds", "2")
        assert bytes(rig.heard) == b""
    drive = only_drive(document)
    assert drive["driver"] == "simplefoc"
    if monitor == "1111111":
        assert drive["options"]["monitor"] == monitor and {"R", "K", "J", "B"} <= set(drive["determined"])
    else:
        assert "monitor" in drive["missing"] and drive["channels"] == [] and "4 numbers" in drive["remark"]


def test_an_mit_actuators_model_is_left_to_its_user(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bus = SlcanBus(MitActuator(sine_motor(0.01), torque_per_ampere=0.1, motor_id=6))
    with line(tmp_path / "can0", bus):
        _, document = scan(capsys, "--can", f"slcan:{tmp_path / 'can0'}", "--seconds", "1")
    drive = only_drive(document)
    assert drive["driver"] == "mit" and drive["options"]["motor_id"] == 6 and "model" not in drive["options"]
    assert "AK80-9" in drive["missing"]["model"] and "# model =" in drive["toml"]
    assert {"J", "B"} <= set(drive["determined"]) and bus.heard == []


@pytest.mark.parametrize("asked", [False, True])
def test_a_canopen_node_is_heard_and_says_the_rest_when_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: bool
) -> None:
    bus = SlcanBus(Cia402Node(sine_motor(0.01), torque_per_ampere=0.1, node_id=9, rated_torque_Nm=0.5))
    where = f"slcan:{tmp_path / 'can0'}"
    with line(tmp_path / "can0", bus):
        _, document = scan(capsys, "--can", where, "--seconds", "1", *(["--ask"] if asked else []))
    if not asked:
        assert document["drives"] == [] and "--ask" in document["remarks"][0] and bus.heard == []
        return
    drive = only_drive(document)
    assert drive["options"] | {"counts_per_rev": 8192, "rated_torque_Nm": 0.5, "node_id": 9} == drive["options"]
    assert {"J", "B"} <= set(drive["determined"])
    reads = {(f.key, f.data) for f in cia402_may_send(9, [*IDENTITY.values(), *STANDARD.values()])}
    assert {(f.frame_id, f.data) for f in bus.heard} <= reads


@pytest.mark.slow
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
        code, document = scan(capsys, "--can", f"slcan:{tmp_path / 'can0'}", "--seconds", "2.5")
    drive = only_drive(document)
    assert code == 0 and drive["driver"] == driver
    assert drive["options"] == {"interface": "slcan", "channel": str(tmp_path / "can0")} | option
    assert signals <= set(drive["channels"])
    assert ("R" in drive["undetermined"]) == (driver == "odrive")
    assert bus.heard == []


@pytest.mark.slow
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


def test_an_answer_to_a_question_of_before_is_no_torque_constant() -> None:
    class Line:
        """Two answers to the driver are still on their way."""

        answers = iter([b"1.25 0.5\r\n0.75\r\n", b"0.0", b"5\r\n0.05\r\n"])

        def send(self, data: bytes) -> None:
            assert data == 2 * TORQUE_CONSTANT[0]

        def receive(self, timeout_s: float) -> bytes:
            return next(self.answers, b"")

    link: Any = Line()
    assert _odrive(link, {}).nominal == {"K": 0.05}
