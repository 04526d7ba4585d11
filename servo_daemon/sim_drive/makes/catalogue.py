"""Simulated drives with the motor that each drives, ready to be served."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from servo_daemon.sim_drive.makes.can_nodes import SlcanBus
from servo_daemon.sim_drive.makes.cia402 import Cia402Node
from servo_daemon.sim_drive.makes.foc import FocDrive, Motion, Pmsm, RunningFoc
from servo_daemon.sim_drive.makes.mit import MitActuator
from servo_daemon.sim_drive.makes.moteus import Fdcanusb, Moteus
from servo_daemon.sim_drive.makes.moving import FocMotor, MovingMotor
from servo_daemon.sim_drive.makes.serve import Device
from servo_daemon.sim_drive.makes.servos import DynamixelChain, FeetechChain
from servo_daemon.sim_drive.makes.simplefoc import SimpleFocMonitor
from servo_daemon.sim_drive.source import SampleSource

#: An actuator with its load at the output: the size of an AK80-9, within its 50 rad/s and 18 N·m.
ACTUATOR = Pmsm(R=0.17, L=57e-6, flux=0.0052, pole_pairs=21, J=0.02, B=0.05, supply_V=48.0)
SLOW = Motion(((15.0, 0.31), (10.0, 0.83), (6.0, 2.1), (2.0, 4.7)))


class Regular:
    """A device that sends by itself, and takes its values at even times however late this process is: as a drive's own
    clock does.

    Args:
        make: the device of a clock, by which its motor goes.
    """

    def __init__(self, make: Callable[[Callable[[], float]], Device]) -> None:
        self._now_s = 0.0
        self._device = make(lambda: self._now_s)
        self.period_s = self._device.period_s

    def receive(self, data: bytes) -> bytes:
        """The device's answer."""
        return self._device.receive(data)

    def due(self) -> bytes:
        """What it sends one period after the last time."""
        self._now_s += self.period_s or 0.0
        return self._device.due()


def _outrunner(seed: int) -> RunningFoc:
    return RunningFoc(FocDrive(seed=seed))


def _simplefoc(seed: int, _: int) -> Device:
    return Regular(lambda clock: SimpleFocMonitor(FocMotor(RunningFoc(FocDrive(seed=seed), clock))))


def _cia402(seed: int, drive_id: int) -> Device:
    def made(clock: Callable[[], float]) -> Device:
        motor = FocMotor(RunningFoc(FocDrive(seed=seed), clock))
        return SlcanBus(Cia402Node(motor, torque_per_ampere=Pmsm().Kt, node_id=drive_id))

    return Regular(made)


def _mit(seed: int, drive_id: int) -> Device:
    def made(clock: Callable[[], float]) -> Device:
        motor = FocMotor(RunningFoc(FocDrive(ACTUATOR, SLOW, seed=seed), clock))
        return SlcanBus(MitActuator(motor, torque_per_ampere=ACTUATOR.Kt, motor_id=drive_id))

    return Regular(made)


#: A motor under field-oriented control: seed and the drive's number on the wire -> the device.
FOC: Mapping[str, Callable[[int, int], Device]] = {
    "moteus": lambda seed, drive_id: Fdcanusb(
        Moteus(FocMotor(_outrunner(seed)), torque_constant=Pmsm().Kt, drive_id=drive_id)
    ),
    "simplefoc": _simplefoc,
    "cia402": _cia402,
    "mit": _mit,
}
#: A brushed motor: its samples and the servo's number -> the device.
BRUSHED: Mapping[str, Callable[[SampleSource, int], Device]] = {
    "dynamixel": lambda source, drive_id: DynamixelChain({drive_id: MovingMotor(source)}),
    "feetech": lambda source, drive_id: FeetechChain({drive_id: MovingMotor(source)}),
}
