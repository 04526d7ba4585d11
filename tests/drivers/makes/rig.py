"""A simulated drive of a known motor on a pseudo-terminal, which keeps everything that the host sends it."""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.base import DriveInfo
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.sim_drive.makes.moving import MovingMotor
from servo_daemon.sim_drive.makes.serve import Device, serve

PATIENCE_S = 30.0

#: A slow sine that stays within one turn: position 2 sin(3 t), what follows from it, and V, A of their own.
AMPLITUDE_RAD, FREQUENCY_RAD_S = 2.0, 3.0


@dataclass
class Sine:
    """A source whose samples are functions of time only."""

    rate_hz: float = 4000.0
    taken: int = field(default=0, init=False)

    @property
    def info(self) -> DriveInfo:
        return DriveInfo("SINE", 1.0 / self.rate_hz)

    def next_block(self, n: int) -> SampleBlock:
        t = (self.taken + np.arange(n)) / self.rate_hz
        self.taken += n
        position = AMPLITUDE_RAD * np.sin(FREQUENCY_RAD_S * t)
        speed = AMPLITUDE_RAD * FREQUENCY_RAD_S * np.cos(FREQUENCY_RAD_S * t)
        return make_block(
            t, voltage_V=voltage_of(speed), current_A=current_of(position), position_rad=position, velocity_rad_s=speed
        )


def voltage_of(speed: np.ndarray) -> np.ndarray:
    """The voltage of `Sine`, V: told apart from every other channel by its factor."""
    return 0.75 * speed


def current_of(position: np.ndarray) -> np.ndarray:
    """The current of `Sine`, A."""
    return -1.5 * position


@dataclass
class Line:
    """A running device: where it is and what the host sent it so far."""

    link: Path
    heard: bytearray = field(default_factory=bytearray)
    stop: threading.Event = field(default_factory=threading.Event)


@contextlib.contextmanager
def line(link: Path, device: Device) -> Iterator[Line]:
    """Serve the device while the context lasts; whatever goes wrong in it fails the test."""
    rig, errors = Line(link), []
    ready = threading.Event()

    def run() -> None:
        try:
            serve(link, device, stop=rig.stop, heard=rig.heard.extend)
        except BaseException as error:
            errors.append(error)
        finally:
            ready.set()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while not link.exists() and not ready.is_set():
        ready.wait(0.002)
    try:
        yield rig
    finally:
        rig.stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive()
    assert not errors, errors


class Silent:
    """A device that is there and says nothing."""

    period_s: float | None = None

    def receive(self, data: bytes) -> bytes:
        return b""

    def due(self) -> bytes:
        return b""


def sine_motor(step_s: float) -> MovingMotor:
    """A motor on `Sine` that goes on by `step_s` each time it is looked at: what it shows does not depend on the load
    of the machine."""
    ticks = itertools.count(1)
    return MovingMotor(Sine(), clock=lambda: step_s * next(ticks))


def assert_follows_the_sine(
    block: SampleBlock,
    step_s: float,
    *,
    voltage: Callable[[np.ndarray], np.ndarray] | None = voltage_of,
    tolerance: float = 0.02,
) -> None:
    """Position, speed, voltage and current of every sample belong together as those of `Sine` do, and from one number
    to the next the phase of the motion goes on by `step_s`."""
    position, speed = block.position_rad, block.velocity_rad_s
    assert position is not None and speed is not None
    radius = np.hypot(position / AMPLITUDE_RAD, speed / (AMPLITUDE_RAD * FREQUENCY_RAD_S))
    np.testing.assert_allclose(radius, 1.0, atol=tolerance)
    if voltage is not None:
        assert block.voltage_V is not None
        np.testing.assert_allclose(block.voltage_V, voltage(speed), atol=tolerance * 5.0)
    if block.current_A is not None:
        np.testing.assert_allclose(block.current_A, current_of(position), atol=tolerance * 3.0)
    phase = np.unwrap(np.arctan2(position / AMPLITUDE_RAD, speed / (AMPLITUDE_RAD * FREQUENCY_RAD_S)))
    steps = np.diff(block.sequence)
    if len(block) > 50 and (steps == 1).all():  # what a loaded machine loses is of unknown length
        np.testing.assert_allclose(np.polyfit(block.sequence, phase, 1)[0], FREQUENCY_RAD_S * step_s, rtol=0.01)
    assert (np.diff(block.time_s) > 0).all()
