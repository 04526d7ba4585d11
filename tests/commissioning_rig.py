"""A motor of `tests.commanded_motor` behind the real serial wire, on a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from drivers.base import DriveInfo
from servo_daemon.samples import F64, SampleBlock, concatenate
from tests.commanded_motor import CommandedMotor

CONFIG = """
[[drive]]
name = "axis1"
driver = "serial"
options = {{ port = "{link}" }}
[drive.commission]
allow_motion = true
voltage_V = {voltage}
current_A = {current}
speed_rad_s = {speed}
travel_rad = {travel}
seconds = {seconds}
"""


@dataclass
class Wired:
    """The motor as a source of samples.

    Attributes:
        voltages: all that it was given, one a sample.
        each: called after every block.
    """

    motor: CommandedMotor
    most_V: float = 100.0
    voltages: list[float] = field(default_factory=list)
    each: Callable[[int], None] = lambda _taken: None

    @property
    def info(self) -> DriveInfo:
        return self.motor.info

    def next_block(self, n: int) -> SampleBlock:
        raise AssertionError("a commanded drive has no motion of its own")

    def commanded_block(self, voltage_V: F64) -> SampleBlock:
        blocks = []
        for v in voltage_V.tolist():
            self.motor.command(v, 0.05)
            block = self.motor.read(0.0)
            assert block is not None
            blocks.append(block)
        self.voltages += voltage_V.tolist()
        self.each(len(self.voltages))
        return concatenate(blocks)


def write_config(path: Path, link: Path, limits: tuple[float, float, float, float, float]) -> Path:
    """With voltage, current, speed, travel and seconds as limits."""
    voltage, current, speed, travel, seconds = limits
    path.write_text(
        CONFIG.format(link=link, voltage=voltage, current=current, speed=speed, travel=travel, seconds=seconds)
    )
    return path
