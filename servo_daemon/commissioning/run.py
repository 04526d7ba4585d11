"""Commissioning from nothing: rest, a first look that grows, then planned rounds until all is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from drivers.commanding import Commanding
from servo_daemon.commissioning import ends
from servo_daemon.commissioning.envelope import Envelope
from servo_daemon.commissioning.limits import MotionLimits
from servo_daemon.commissioning.prediction import Prediction
from servo_daemon.commissioning.rounds import SHARES, planned
from servo_daemon.commissioning.session import Session
from servo_daemon.commissioning.stop import Stop, StoppedError
from servo_daemon.commissioning.waves import GROWTH_S, growing
from servo_daemon.errors import BadInputError, NumericalError
from servo_daemon.identification.output_error import OutputErrorFit, Recording, fit_output_error
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.samples import SampleBlock

#: Before the first voltage: noise and offset of the current are taken; after a motion: it runs down. s.
_REST_S, _PAUSE_S = 0.3, 0.2
#: The first look has seen enough when one of these shares of its limit was reached; of the current more while the
#: motor is slow: friction takes it.
_CURRENT, _SPEED, _TRAVEL = 0.3, 0.3, 0.12
_CURRENT_IF_SLOW, _SLOW = 0.5, 0.1
#: And when the shaft has gone this many counts.
_COUNTS = 40
#: A plan needs these, and other models of dry friction than Coulomb's.
_PLANNED_WITH = ("R", "K", "J")
_DRY = ("stribeck_friction", "asymmetric_friction", "load_dependent_friction", "position_dependent_friction")
#: What a first look may leave open: friction as a share of the braking by the back-EMF, inductance as a time constant
#: in samples. Only until a round shows them.
_FRICTION, _INDUCTANCE = 0.02, 0.5
#: The centring that keeps the shaft near its start: rad/s, and a share of what the motor's time constant allows.
_CENTRING_RAD_S, _CENTRING_SHARE = 1.0, 0.15
#: A shaft at 0 V stops within this many mechanical time constants, as its speed times it.
_STOPPING = 1.5
#: After so many rounds that the model does not explain, more motion does not help.
_ROUNDS = 2
#: Shortest stretch of samples without a gap that is fitted, s; shortest round, s.
_STRETCH_S, _SHORTEST_S = 0.5, 2.0
#: The end of a first look, s: the time in which its wave grows e-fold, and the pause after it.
_MOVING_S = GROWTH_S + _PAUSE_S

Outcome = Literal["known", "stopped", "unexplained", "not_known"]
Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Ask:
    """What is wanted.

    Attributes:
        accuracy: 1 σ of every parameter, as a share of its value.
        effects: of the model.
        seed: of the motion.
    """

    accuracy: float = 0.01
    effects: tuple[str, ...] = ()
    seed: int = 0


@dataclass(frozen=True)
class Commissioning:
    """What a run came to.

    Attributes:
        outcome: "known": all to the accuracy asked for; "stopped"; "unexplained": the model lacks something, a
            diagnosis of the samples may name it; "not_known": the time was used up.
        stop: why it was stopped.
        fit: of all samples; None: there was too little.
        unknown: parameters that are not known well enough.
        block: all samples, from rest to rest.
        motion_s: time of motion.
        peaks: by channel the greatest modulus that was measured.
    """

    outcome: Outcome
    stop: Stop | None
    fit: OutputErrorFit | None
    unknown: tuple[str, ...]
    block: SampleBlock
    motion_s: float
    peaks: Mapping[str, float]


class _Run:
    def __init__(self, drive: Commanding, limits: MotionLimits, ask: Ask, interrupted: Callable[[], bool]) -> None:
        self.session = Session(drive, limits, interrupted)
        self._limits, self._ask = limits, ask
        self.fit: OutputErrorFit | None = None
        self.unexplained = False
        self._working: Mapping[str, float] = {}  # values to plan with

    def all(self, progress: Progress) -> None:
        """Everything.

        Raises:
            StoppedError: it was stopped.
        """
        progress(0.0, "at rest")
        self.session.rest(_REST_S)
        self.session.supervisor.resting = False
        progress(0.0, "first look")
        self._first_look()
        self._learn()
        k = 0
        while (unknown := self.unknown()) and self.session.time_left_s > _SHORTEST_S:
            progress(self.session.motion_s, f"round {k + 1}: {', '.join(unknown)}")
            self._round(unknown, SHARES[min(k, len(SHARES) - 1)], k)
            self._learn()
            k += 1
            if k >= _ROUNDS and self.fit is not None and not self.fit.white:
                self.unexplained = True
                return

    def unknown(self) -> tuple[str, ...]:
        """Parameters that are not known to the accuracy asked for."""
        return unknown_in(self.fit, self._ask.accuracy)

    def _first_look(self) -> None:
        s, lim = self.session.supervisor, self._limits

        def enough() -> bool:
            slow = s.peak_speed_rad_s < _SLOW * lim.speed_rad_s
            return s.peak_travel_rad > _COUNTS * self.session.count_rad and (
                s.peak_current_A > (_CURRENT_IF_SLOW if slow else _CURRENT) * lim.current_A
                or s.peak_speed_rad_s > _SPEED * lim.speed_rad_s
                or s.peak_travel_rad > _TRAVEL * lim.travel_rad
            )

        self.session.play(growing(1.0 / self.session.period_s, lim.voltage_V, self._ask.seed), enough)
        if not s.has_moved and s.last is not None and self.session.time_left_s > 0.0:
            stop = Stop("no_motion", "the shaft does not move at any voltage tried", s.last.time_s)
            raise StoppedError(self.session.named(stop))
        self.session.rest(_PAUSE_S)

    def _round(self, unknown: tuple[str, ...], share: float, k: int) -> None:
        motor = self._motor()
        session, s = self.session, self.session.supervisor
        braking = motor["R"] * motor["B"] + motor["K"] ** 2
        time_constant_s = motor["J"] * motor["R"] / braking
        session.envelope = Envelope.of(self._cautious(motor), self._limits.voltage_V, self._limits.current_A)
        s.bounded_current = True
        s.stopping_s = _STOPPING * time_constant_s
        session.centring_V_rad = motor["K"] * min(_CENTRING_RAD_S, _CENTRING_SHARE / time_constant_s)
        wave = planned(session, self._limits, motor, self._ask.effects, unknown, share, self._ask.seed + k)
        session.catch_up()
        assert s.last is not None
        session.prediction = Prediction(
            motor,
            session.period_s,
            session.count_rad,
            s.current_noise_A,
            s.offset_A,
            s.last,
            (s.peak_speed_rad_s, s.peak_current_A),
        )
        session.play(wave)
        session.rest(_PAUSE_S)
        session.prediction = None

    def _motor(self) -> dict[str, float]:
        """All five as far as they are known."""
        found = self._working
        if missing := [name for name in _PLANNED_WITH if name not in found]:
            told = f"the first look does not show {', '.join(missing)}"
            if at := self.session.ends():
                raise StoppedError(Stop("hard_stop", f"{ends.words(at)}; {told}", self.session.now_s))
            text = f"{told}: it sticks, is stopped, or samples are lost"
            raise StoppedError(Stop("innovations", text, self.session.now_s))
        out = {name: value for name, value in found.items() if name in MOTOR_NAMES}
        out.setdefault("L", _INDUCTANCE * self.session.period_s * out["R"])
        out.setdefault("B", _FRICTION * out["K"] ** 2 / out["R"])
        return {name: out[name] for name in MOTOR_NAMES}

    def _cautious(self, motor: Mapping[str, float]) -> dict[str, float]:
        """The resistance as low and K as high as they may be: two standard deviations, and half and twice at most."""
        known = {} if self.fit is None else self.fit.parameters
        R, K = (known[name].std if name in known else None for name in ("R", "K"))
        return {
            **motor,
            "R": 0.5 * motor["R"] if R is None else max(motor["R"] - 2 * R, 0.5 * motor["R"]),
            "K": 2.0 * motor["K"] if K is None else min(motor["K"] + 2 * K, 2.0 * motor["K"]),
        }

    def _learn(self) -> None:
        """A fit of all samples so far; none where they tell too little. Where the model asked for leaves the motor
        open, dry friction, the commonest cause, gives values to plan with: they need not explain everything, and the
        end, where the shaft moves most, may tell more than all the time in which it stuck.

        Raises:
            StoppedError: there are gaps everywhere.
        """
        recordings = stretches(self.session.block(), self.session.period_s)
        self.fit = _fitted(recordings, self._ask.effects)
        before, self._working = self._working, {} if self.fit is None else self.fit.values
        if not recordings:
            text = f"samples are lost all the time: there are no {_STRETCH_S:g} s without a gap"
            raise StoppedError(Stop("data_missing", text, float(self.session.block().time_s[-1])))
        if not {"coulomb_friction", *_DRY} & set(self._ask.effects):
            for part in (recordings, _ends(recordings)):
                if not self._enough_to_plan():
                    rough = _fitted(part, (*self._ask.effects, "coulomb_friction"))
                    self._working = {} if rough is None else rough.values
        if not self._enough_to_plan():
            self._working = before or self._working  # a motor is what it was

    def _enough_to_plan(self) -> bool:
        return all(name in self._working for name in _PLANNED_WITH)


def _ends(recordings: list[Recording]) -> list[Recording]:
    """The last `_MOVING_S` of each."""
    blocks = [(r.name, r.block) for r in recordings]
    return [
        Recording(name, block.slice(int(np.searchsorted(block.time_s, block.time_s[-1] - _MOVING_S)), len(block)))
        for name, block in blocks
    ]


def _fitted(recordings: list[Recording], effects: tuple[str, ...]) -> OutputErrorFit | None:
    try:
        return fit_output_error(recordings, effects) if recordings else None
    except (BadInputError, NumericalError):
        return None


def unknown_in(fit: OutputErrorFit | None, accuracy: float) -> tuple[str, ...]:
    """Parameters whose 1 σ is more than this share of their value, or that have none."""
    if fit is None:
        return MOTOR_NAMES
    return tuple(
        name
        for name, p in fit.parameters.items()
        if p.status != "fixed" and not (p.value is not None and p.std is not None and p.std <= accuracy * abs(p.value))
    )


def stretches(block: SampleBlock, period_s: float) -> list[Recording]:
    """The samples without gaps and without flags, in pieces; short ones are left out."""
    breaks = np.flatnonzero(np.diff(block.time_s) > 1.5 * period_s) + 1
    edges = [0, *breaks.tolist(), len(block)]
    pieces = [(a, b) for a, b in pairwise(edges) if (b - a) * period_s >= _STRETCH_S]
    return [Recording(f"commission-{k + 1}", block.slice(a, b)) for k, (a, b) in enumerate(pieces)]


def commission(
    drive: Commanding,
    limits: MotionLimits,
    ask: Ask | None = None,
    interrupted: Callable[[], bool] = lambda: False,
    progress: Progress = lambda _seconds, _step: None,
) -> Commissioning:
    """Moves the motor of an open drive until its parameters are known, and leaves it at 0 V.

    Args:
        interrupted: asked at every read; true stops the motor at once.
        progress: told seconds of motion and what is done.

    Raises:
        DriverError: the drive sends nothing, or not what is needed; it went away.
        BadInputError: no motion stays within the limits.
    """
    run = _Run(drive, limits, ask or Ask(), interrupted)
    stop = None
    try:
        run.all(progress)
    except StoppedError as error:
        stop = error.stop
    unknown, s = run.unknown(), run.session.supervisor
    return Commissioning(
        outcome=_outcome(run, stop, unknown),
        stop=stop,
        fit=run.fit,
        unknown=unknown,
        block=run.session.block(),
        motion_s=run.session.motion_s,
        peaks={
            "voltage_V": s.peak_voltage_V,
            "current_A": s.peak_current_A,
            "speed_rad_s": s.peak_speed_rad_s,
            "travel_rad": s.peak_travel_rad,
        },
    )


def _outcome(run: _Run, stop: Stop | None, unknown: tuple[str, ...]) -> Outcome:
    if stop is not None:
        return "stopped"
    if not unknown:
        return "known"
    return "unexplained" if run.unexplained else "not_known"
