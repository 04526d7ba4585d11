"""The independent motors of the tests behind the wires of the makes: traces played to simulated drives, whose bytes the
drivers read in lockstep."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np
from scipy.signal import lfilter

from drivers.base import DriveInfo
from drivers.can.decode import batch_of
from drivers.polling.can_link import Frame, pack, unpack
from drivers.polling.poller import Reply, Request
from drivers.servo_bus.chain import State
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.sim_drive.makes import odrive as simulated_odrive
from servo_daemon.sim_drive.makes.cia402 import Cia402Node
from servo_daemon.sim_drive.makes.foc import Pmsm, RunningFoc, Sums
from servo_daemon.sim_drive.makes.mit import MitActuator
from servo_daemon.sim_drive.makes.moteus import Fdcanusb, Moteus
from servo_daemon.sim_drive.makes.moving import FocMotor as ShownMotor
from servo_daemon.sim_drive.makes.moving import MovingMotor
from servo_daemon.sim_drive.makes.odrive import OdriveNode
from servo_daemon.sim_drive.makes.servos import DynamixelChain, FeetechChain
from servo_daemon.sim_drive.makes.simplefoc import SimpleFocMonitor
from servo_daemon.sim_drive.makes.vesc import VescDevice, VescNode
from servo_daemon.sim_drive.slcan_adapter import BusFrame
from tests.recovery.foc.lockstep import Clock, by_lines, closed, closed_can, exchanged, polled
from tests.recovery.foc.motor import CONTROL_HZ, FocMotor, Trace
from tests.recovery.generator import Recording

#: From one frame to the next on a bus of 500 kbit/s.
FRAME_S = 2.6e-4
#: Of an encoder of 14 bits.
_COUNT_RAD = 2.0 * math.pi / 16384
#: A share of a control period at which its values are there to be read.
_WITHIN = 0.5 / CONTROL_HZ


class Played:
    """A trace as the firmware of a simulated drive sees it (`FocDrive`): what the last control period measured and
    applied.

    Args:
        after_s: of the trace that has gone by at the clock's 0.
    """

    def __init__(self, trace: Trace, motor: FocMotor, after_s: float = 0.0) -> None:
        self.motor = Pmsm(
            motor.R, motor.L, motor.flux, motor.pole_pairs, motor.J, motor.B, motor.Tc, motor.bus_V,
            motor.current_limit_A,
        )  # fmt: skip
        self._trace, self._first, self._k = trace, round(after_s * CONTROL_HZ), 0
        self._filtered = lfilter([0.1], [1.0, -0.9], trace.i)
        motoring = np.sign(trace.v * trace.i) * lfilter([0.1], [1.0, -0.9], np.abs(trace.i))
        self._sums = [np.concatenate([[0.0], np.cumsum(x)]) for x in (trace.i, trace.v, motoring)]

    def advance_to(self, time_s: float) -> None:
        self._k = min(round((time_s + _WITHIN) * CONTROL_HZ), len(self._trace.i) - 1 - self._first)

    @property
    def time_s(self) -> float:
        return self._k / CONTROL_HZ

    def _now(self, values: np.ndarray) -> float:
        return float(values[self._first + self._k])

    @property
    def theta(self) -> float:
        """By an encoder of 14 bits."""
        return round(self._now(self._trace.th) / _COUNT_RAD) * _COUNT_RAD

    @property
    def omega(self) -> float:
        return self._now(self._trace.w)

    @property
    def i_q(self) -> float:
        return self._now(self._trace.i)

    @property
    def i_q_filtered(self) -> float:
        return self._now(self._filtered)

    @property
    def v_q(self) -> float:
        return self._now(self._trace.v)

    @property
    def v_d(self) -> float:
        return self._now(self._trace.vd)

    @property
    def v_q_parts(self) -> tuple[float, float]:
        return self._now(self._trace.vq_integral), self.motor.pole_pairs * self.omega * self.motor.flux

    @property
    def sums(self) -> Sums:
        i, v, motoring = map(self._now, self._sums)
        return Sums(self._k + self._first, 0.0, i, 0.0, v, motoring)


class _Samples:
    """A recording as the source of a brushed servo's samples."""

    def __init__(self, recording: Recording) -> None:
        self._of, self._taken = recording, 0
        self.info = DriveInfo("recorded", float(np.median(np.diff(recording.time_s))))

    def next_block(self, n: int) -> SampleBlock:
        cut = slice(self._taken, self._taken + n)
        self._taken += n
        of = self._of
        return make_block(
            of.time_s[cut], voltage_V=of.voltage_V[cut], current_A=of.current_A[cut],
            position_rad=of.position_rad[cut], velocity_rad_s=of.truth.speed_rad_s[cut],
        )  # fmt: skip


@dataclass(frozen=True)
class Read:
    """A driver and what it reads."""

    driver: Any
    blocks: Iterator[SampleBlock]


#: A driver's blocks from a motor's trace (or recording): motor, trace, clock's start in the trace, rate, seconds.
Wire = Callable[[Any, Any, float, float, float], Read]


def _running(motor: FocMotor, trace: Trace, after_s: float) -> tuple[Clock, Any]:
    clock = Clock()
    played: Any = Played(trace, motor, after_s)
    return clock, RunningFoc(played, clock)


class SharedVesc(VescDevice):
    """One whose averages another program reads too, at intervals of 0.8 to 1.2 of its period."""

    def __init__(self, running: Any, clock: Clock, another_hz: float) -> None:
        super().__init__(running)
        self._clock, self._hz, self._rng, self._at_s = clock, another_hz, np.random.default_rng(0), 0.0

    def receive(self, data: bytes) -> bytes:
        now_s = self._clock.now_s
        while self._at_s < now_s:
            self._clock.now_s = self._at_s
            self.read_by_another()
            self._at_s += float(self._rng.uniform(0.8, 1.2)) / self._hz
        self._clock.now_s = now_s
        return super().receive(data)


def vesc_polled(
    motor: FocMotor, trace: Trace, after_s: float, hz: float, seconds: float, another_hz: float = 0.0
) -> Read:
    clock, running = _running(motor, trace, after_s)
    driver = closed("vesc", rate_hz=float(hz), pole_pairs=motor.pole_pairs)
    device = SharedVesc(running, clock, another_hz) if another_hz else VescDevice(running)
    return Read(driver, polled(driver, driver._new_dialogue(), device, clock, hz, round(seconds * hz)))


def bursts(driver: Any, node: Any, clock: Clock, n: int) -> Iterator[SampleBlock]:
    """What a node sends by itself, a batch a burst, frame after frame."""
    for k in range(n):
        clock.now_s = k * node.period_s
        messages = [
            can.Message(
                timestamp=clock.now_s + j * FRAME_S,
                arbitration_id=f.frame_id,
                data=f.data,
                is_extended_id=f.extended,
            )
            for j, f in enumerate(node.due())
        ]
        yield from driver._frames.feed(batch_of(messages, clock.now_s + 2e-3, 1e9 + clock.now_s))


def vesc_can(motor: FocMotor, trace: Trace, after_s: float, hz: float, seconds: float) -> Read:
    clock, running = _running(motor, trace, after_s)
    driver = closed_can("vesc", can_id=7, pole_pairs=motor.pole_pairs)
    return Read(driver, bursts(driver, VescNode(running, rate_hz=hz), clock, round(seconds * hz)))


def odrive_can(motor: FocMotor, trace: Trace, after_s: float, hz: float, seconds: float, generation: Any) -> Read:
    clock, running = _running(motor, trace, after_s)
    driver = closed_can("odrive")
    node = OdriveNode(running, generation=generation, node_id=5, period_s=1.0 / hz)
    return Read(driver, bursts(driver, node, clock, round(seconds * hz)))


def odrive_asked(motor: FocMotor, trace: Trace, after_s: float, hz: float, seconds: float) -> Read:
    """SDO reads, each answered two frames after the one before."""
    clock, running = _running(motor, trace, after_s)
    table = {name: {"id": number, "type": "float"} for name, number in simulated_odrive.ENDPOINTS.items()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flat_endpoints.json"
        path.write_text(json.dumps({"fw_version": "0.6.10-1", "hw_version": "4.4.58", "endpoints": table}))
        driver = closed_can("odrive", endpoints=str(path), pole_pairs=motor.pole_pairs, rate_hz=float(hz))
    node, dialogue = OdriveNode(running), driver._new_dialogue()

    def exchange(data: bytes) -> list[Reply[Any]]:
        replies: list[Reply[Any]] = []
        for frame in unpack(data):
            clock.now_s += 2.0 * FRAME_S
            for answer in node.receive(BusFrame(frame.key, frame.data)):
                replies += dialogue.feed(pack(Frame(answer.frame_id, answer.data)))
        return replies

    return Read(driver, exchanged(driver, dialogue, exchange, clock, hz, round(seconds * hz)))


def moteus(motor: FocMotor, trace: Trace, after_s: float, hz: float, seconds: float, signal: str) -> Read:
    clock, running = _running(motor, trace, after_s)
    driver = closed("moteus", signal=signal, pole_pairs=motor.pole_pairs, rate_hz=float(hz))
    device = Fdcanusb(Moteus(ShownMotor(running), torque_constant=running.now().motor.Kt))
    dialogue = driver._new_dialogue()
    exchange = by_lines(dialogue, device, clock)
    return Read(driver, exchanged(driver, dialogue, exchange, clock, hz, round(seconds * hz)))


def simplefoc(motor: FocMotor, trace: Trace, after_s: float, hz: float, seconds: float) -> Read:
    clock, running = _running(motor, trace, after_s)
    driver = closed("simplefoc", period_s=1.0 / hz, pole_pairs=motor.pole_pairs)
    device, decoder = SimpleFocMonitor(ShownMotor(running), period_s=1.0 / hz), driver._decoder

    def blocks() -> Iterator[SampleBlock]:
        decoder.feed(b"\n", 0.0)
        for k in range(round(seconds * hz)):
            clock.now_s = k / hz
            block = decoder.feed(device.due(), clock.now_s)
            if block is not None:
                yield block

    return Read(driver, blocks())


def cia402(motor: FocMotor, trace: Trace, after_s: float, hz: float, seconds: float) -> Read:
    clock, running = _running(motor, trace, after_s)
    Kt = running.now().motor.Kt
    rated_Nm = Kt * motor.current_limit_A / 3.0
    driver = closed_can(
        "cia402", pdo={"0x181": ["statusword", "position", "torque"]}, counts_per_rev=8192,
        rated_torque_Nm=rated_Nm, period_s=1.0 / hz,
    )  # fmt: skip
    node = Cia402Node(ShownMotor(running), torque_per_ampere=Kt, rated_torque_Nm=rated_Nm, period_s=1.0 / hz)
    return Read(driver, bursts(driver._inner, node, clock, round(seconds * hz)))


def mit(motor: FocMotor, trace: Trace, after_s: float, hz: float, seconds: float) -> Read:
    """Limits that suit the motor: its largest torque is half of the codes."""
    clock, running = _running(motor, trace, after_s)
    Kt = running.now().motor.Kt
    limits = (12.5, 150.0, 2.0 * float(np.abs(trace.i).max()) * Kt)
    driver = closed_can("mit", limits=list(limits), layout="mit", period_s=1.0 / hz)
    node = MitActuator(ShownMotor(running), limits=limits, torque_per_ampere=Kt, period_s=1.0 / hz)
    return Read(driver, bursts(driver, node, clock, round(seconds * hz)))


class OneServo:
    """Reads of the registers of servo 1."""

    def __init__(self, family: Any) -> None:
        self._family, self._decoder = family, family.decoder()

    def next_request(self) -> Request:
        return Request(self._family.read(1, self._family.address, self._family.length))

    def feed(self, data: bytes) -> list[Reply[State]]:
        return [Reply(0, State(s.data, s.error)) for s in self._decoder.feed(data)]


def servo(_motor: Any, recording: Recording, after_s: float, hz: float, seconds: float, kind: str) -> Read:
    clock, driver = Clock(), closed(kind, rate_hz=float(hz))
    driver._place.model = 1020
    moving = MovingMotor(_Samples(recording), lambda: clock.now_s + after_s)
    device = (DynamixelChain if kind == "dynamixel" else FeetechChain)({1: moving})
    return Read(driver, polled(driver, OneServo(driver._family), device, clock, hz, round(seconds * hz)))


def nominal_of(read: Read, truth: Mapping[str, float]) -> dict[str, float]:
    """K where only a current drives the mechanics."""
    channels = read.driver.info.channels
    by_current = "current_A" in channels and not {"voltage_V", "torque_Nm"} & set(channels)
    return {"K": truth["K"]} if by_current else {}
