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


def _outrunner(seed: int) -> RunningFoc:
    return RunningFoc(FocDrive(seed=seed))


def _actuator(seed: int) -> FocMotor:
    return FocMotor(RunningFoc(FocDrive(ACTUATOR, SLOW, seed=seed)))


#: A motor under field-oriented control: seed and the drive's number on the wire -> the device.
FOC: Mapping[str, Callable[[int, int], Device]] = {
    "moteus": lambda seed, drive_id: Fdcanusb(
        Moteus(FocMotor(_outrunner(seed)), torque_constant=Pmsm().Kt, drive_id=drive_id)
    ),
    "simplefoc": lambda seed, _: SimpleFocMonitor(FocMotor(_outrunner(seed))),
    "cia402": lambda seed, drive_id: SlcanBus(
        Cia402Node(FocMotor(_outrunner(seed)), torque_per_ampere=Pmsm().Kt, node_id=drive_id)
    ),
    "mit": lambda seed, drive_id: SlcanBus(
        MitActuator(_actuator(seed), torque_per_ampere=ACTUATOR.Kt, motor_id=drive_id)
    ),
}
#: A brushed motor: its samples and the servo's number -> the device.
BRUSHED: Mapping[str, Callable[[SampleSource, int], Device]] = {
    "dynamixel": lambda source, drive_id: DynamixelChain({drive_id: MovingMotor(source)}),
    "feetech": lambda source, drive_id: FeetechChain({drive_id: MovingMotor(source)}),
}
