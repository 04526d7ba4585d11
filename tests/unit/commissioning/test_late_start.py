"""A machine that is late: before anything has moved a motion begins anew, afterwards it is a stop."""

from __future__ import annotations

import gc
import itertools
from collections.abc import Callable

import numpy as np
import pytest

from servo_daemon.commissioning import MotionLimits
from servo_daemon.commissioning.session import Session
from servo_daemon.commissioning.stop import StoppedError
from servo_daemon.samples import F64, SampleBlock, concatenate
from tests.commanded_motor import CommandedMotor, Setup

LIMITS = MotionLimits(12.0, 6.0, 150.0, 30.0, 60.0)
WAVE = np.sin(np.arange(1, 201) / 20.0)
#: Longer than any command is valid, in samples of 1 ms.
LATE = 80


class Late(CommandedMotor):
    """A drive with a dead man, whose host now and then lets samples pass before it commands.

    Attributes:
        late: asked before every voltage that is not zero.
        silent: reads that find nothing, from now on.
    """

    late: Callable[[], bool] = staticmethod(lambda: False)
    silent = 0
    can_wait = False
    _unread: tuple[tuple[SampleBlock, float], ...] = ()
    _acting: F64 = np.zeros(0)

    def command(self, voltage_V: float, valid_for_s: float) -> None:
        if voltage_V != 0.0 and self.late():
            self.pass_by(LATE)
        if voltage_V == 0.0 or self._acts:
            super().command(voltage_V, valid_for_s)

    @property
    def _acts(self) -> bool:
        return self._n / self.setup.rate_hz < self._until_s

    def pass_by(self, n: int) -> None:
        """Samples that the host has not read yet."""
        for _ in range(n):
            acting = self.commanded_V if self._acts else float("nan")
            block = super().read(0.0)
            assert block is not None
            self._unread += ((block, acting),)

    def lose(self) -> None:
        """What waits is lost."""
        self._unread = ()

    def read(self, timeout_s: float) -> SampleBlock | None:
        if self.silent or (timeout_s == 0.0 and not self._unread):
            self.silent = max(0, self.silent - 1)
            return None
        if not self._unread:
            self.pass_by(1)
        blocks, acting = zip(*self._unread, strict=True)
        self._unread, self._acting = (), np.array(acting)
        return concatenate(list(blocks))

    def acting_V(self, block: SampleBlock) -> F64:
        return self._acting


def at_rest(motor: Late) -> Session:
    session = Session(motor, LIMITS, lambda: False)
    session.rest(0.05)
    session.supervisor.resting = False
    return session


def test_a_start_that_came_too_late_is_made_again() -> None:
    motor = Late(Setup())
    session = at_rest(motor)
    motor.late = iter([True, True, False, *[False] * len(WAVE)]).__next__
    session.play(WAVE)
    block = session.block()
    assert block.voltage_V is not None
    np.testing.assert_allclose(block.voltage_V[block.voltage_V != 0.0], WAVE[1:])
    assert session.motion_s == pytest.approx(0.199, abs=0.002)
    assert motor.commanded_V == 0.0


def test_a_machine_that_is_always_late_is_told_and_nothing_moves() -> None:
    motor = Late(Setup())
    session = at_rest(motor)
    motor.late = lambda: True
    with pytest.raises(StoppedError, match=r"5 starts came to nothing: the drive went to 0 V by itself") as told:
        session.play(WAVE)
    assert told.value.stop.reason == "command_lost"
    assert motor.peaks["voltage_V"] == 0.0 and session.motion_s == 0.0


def test_in_the_middle_of_a_motion_it_is_a_stop() -> None:
    motor = Late(Setup())
    session = at_rest(motor)
    asked = itertools.count()
    motor.late = lambda: next(asked) == 20
    with pytest.raises(StoppedError, match="no command came in time for 20 ms") as told:
        session.play(WAVE)
    assert told.value.stop.reason == "command_lost"
    assert motor.commanded_V == 0.0


def test_no_garbage_is_collected_while_a_motor_is_driven() -> None:
    motor = Late(Setup())
    session = at_rest(motor)
    collected: list[bool] = []

    def asked() -> bool:
        collected.append(gc.isenabled())
        return len(collected) == 150

    motor.late = asked
    with pytest.raises(StoppedError):
        session.play(WAVE)
    assert len(collected) == 150 and not any(collected)
    assert gc.isenabled()


def test_a_drive_that_is_silent_after_a_plan_is_waited_for() -> None:
    motor = Late(Setup())
    session = at_rest(motor)
    motor.pass_by(LATE)  # nobody commanded while it was planned
    motor.silent = 3
    session.catch_up()
    session.play(WAVE)
    assert motor.peaks["voltage_V"] == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize("driven", [False, True])
def test_lost_samples_stop_what_is_driven_and_nothing_else(driven: bool) -> None:
    motor = Late(Setup())
    session = at_rest(motor)
    asked = itertools.count()

    def lose() -> bool:
        if next(asked) == (20 if driven else 0):
            motor.pass_by(LATE)
            motor.lose()
        return False

    motor.late = lose
    if not driven:
        session.play(WAVE)
        return
    with pytest.raises(StoppedError) as told:
        session.play(WAVE)
    assert told.value.stop.reason == "command_lost"
