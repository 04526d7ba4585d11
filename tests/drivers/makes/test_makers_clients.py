"""The makers' own Python libraries as clients of the simulated drives: what they read is what the motor does.

They are no dependencies of the project: where one is not installed, its test is skipped.
"""

from __future__ import annotations

import asyncio
import importlib.util
import math
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
from servo_daemon.sim_drive.makes.cia402 import Cia402Node
from servo_daemon.sim_drive.makes.foc import FocDrive, RunningFoc
from servo_daemon.sim_drive.makes.moteus import Fdcanusb, Moteus
from servo_daemon.sim_drive.makes.moving import Shown
from servo_daemon.sim_drive.makes.odrive import OdriveNode
from servo_daemon.sim_drive.makes.servos import DynamixelChain
from tests.drivers.makes.rig import line

#: What every drive here shows.
NOW = Shown(1.0, voltage_V=3.0, current_A=-0.75, position_rad=1.25, velocity_rad_s=-2.5)


class Standing:
    """A motor that shows the same for ever."""

    def now(self) -> Shown:
        return NOW


def test_moteus_reads_its_registers(tmp_path: Path) -> None:
    moteus = pytest.importorskip("moteus", reason="the maker's library is not installed: pip install moteus")
    with line(tmp_path / "fdcanusb", Fdcanusb(Moteus(Standing(), torque_constant=0.2, drive_id=4))):

        async def read() -> tuple[dict[int, float], Any]:
            with moteus.Transport([moteus.FdcanusbDevice(str(tmp_path / "fdcanusb"))]) as transport:
                controller = moteus.Controller(id=4, transport=transport)
                state = await controller.query()
                told = await moteus.Stream(controller, use_flow_control=False).read_data("servo_control")
                return dict(state.values), told

        values, told = asyncio.run(asyncio.wait_for(read(), 20.0))
    register = moteus.Register
    assert values[register.POSITION] == pytest.approx(NOW.position_rad / math.tau, rel=1e-5)
    assert values[register.VELOCITY] == pytest.approx(NOW.velocity_rad_s / math.tau, rel=1e-5)
    assert told.q_V == pytest.approx(NOW.voltage_V / 1.5)
    assert values[register.TORQUE] == pytest.approx(0.2 * NOW.current_A, rel=1e-5)


def test_dynamixel_sdk_finds_and_reads_servos(tmp_path: Path) -> None:
    sdk = pytest.importorskip("dynamixel_sdk", reason="the maker's library is not installed: pip install dynamixel-sdk")
    with line(tmp_path / "chain", DynamixelChain({1: Standing(), 7: Standing()})):
        port, protocol = sdk.PortHandler(str(tmp_path / "chain")), sdk.PacketHandler(2.0)
        assert port.openPort()
        try:
            found, result = protocol.broadcastPing(port)
            assert result == sdk.COMM_SUCCESS and {i: model for i, (model, _) in found.items()} == {1: 1020, 7: 1020}
            group = sdk.GroupSyncRead(port, protocol, 124, 23)
            assert group.addParam(1) and group.addParam(7)
            assert group.fastSyncRead() == sdk.COMM_SUCCESS
            for servo in (1, 7):
                assert _signed(group.getData(servo, 126, 2), 16) == round(NOW.current_A / 2.69e-3)
                assert _signed(group.getData(servo, 132, 4), 32) == round(NOW.position_rad * 4096 / math.tau)
        finally:
            port.closePort()


def _signed(value: int, bits: int) -> int:
    return value - (1 << bits) if value >> (bits - 1) else value


def test_canopen_reads_a_node(tmp_path: Path) -> None:
    canopen = pytest.importorskip("canopen", reason="the library is not installed: pip install canopen")
    node = Cia402Node(Standing(), torque_per_ampere=0.2, node_id=5, rated_torque_Nm=0.5)
    with line(tmp_path / "can0", SlcanBus(node)):
        network = canopen.Network()
        network.connect(interface="slcan", channel=str(tmp_path / "can0"), bitrate=1_000_000, sleep_after_open=0.1)
        try:
            remote = network.add_node(5, canopen.ObjectDictionary())
            assert remote.nmt.wait_for_heartbeat(timeout=10) == "OPERATIONAL"
            number = {key: int.from_bytes(remote.sdo.upload(*key), "little", signed=True) for key in _OBJECTS}
        finally:
            network.disconnect()
    assert number[0x1000, 0] & 0xFFFF == 402 and number[0x608F, 1] == 8192
    assert number[0x6064, 0] == round(NOW.position_rad * 8192 / math.tau)
    assert number[0x6077, 0] == round(1e3 * 0.2 * NOW.current_A / 0.5)


_OBJECTS = ((0x1000, 0), (0x608F, 1), (0x6064, 0), (0x6077, 0))


@pytest.mark.parametrize(("generation", "release"), [("0.5", "0.5.6"), ("0.6", "0.6.10")])
def test_the_messages_of_an_odrive_are_those_of_its_dbc(generation: str, release: str) -> None:
    package = importlib.util.find_spec("odrive_can")
    if package is None or not package.submodule_search_locations:
        pytest.skip("the DBC files are not installed: pip install odrive-can")
    cantools = pytest.importorskip("cantools.database")
    dbc = cantools.load_file(Path(package.submodule_search_locations[0]) / "dbc" / f"odrive-cansimple-{release}.dbc")
    drive = FocDrive()
    drive.advance_to(0.3)
    clock = iter([0.0, *[0.0] * 9])
    frames = OdriveNode(RunningFoc(drive, lambda: next(clock)), generation=generation, node_id=3).due()
    told = {name: value for f in frames for name, value in dbc.decode_message(f.frame_id, f.data).items()}
    assert told["Pos_Estimate"] == pytest.approx(drive.theta / math.tau, rel=1e-6)
    assert told["Vel_Estimate"] == pytest.approx(drive.omega / math.tau, rel=1e-6)
    assert told["Iq_Measured"] == pytest.approx(drive.i_q_filtered, rel=1e-6)
    assert told["Bus_Voltage"] == pytest.approx(drive.motor.supply_V)
    if generation == "0.6":
        assert told["Torque_Estimate"] == pytest.approx(drive.motor.Kt * drive.i_q_filtered, rel=1e-6)
