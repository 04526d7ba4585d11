"""What is fitted to what: recordings cut into segments, the unknowns in one vector, residuals and their derivatives.

The vector of unknowns is laid out as

    shared parameters | each recording's own offsets | each segment's initial state

in the parameters' coordinates (logarithms where positive). Nothing here decides anything: `solver.py` minimises.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.output_error.problem.rollout import STEP, free_runs, free_states
from servo_daemon.plant.at_once import alike
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64

#: A state that the data do not show (the angle where only a speed is measured, the current of a fast winding) is kept
#: near its start by a prior this many times as wide as the signal is large: it decides nothing where data do.
_STATE_PRIOR = 100.0
#: No winding of a servo motor is slower, s: catalogues say L/R of 0.1 ms (coreless) to 50 ms (frameless torque motors).
#: A slower one makes a spring of the winding (a torque −K²/L θ), which is the gravity of whatever the motor lifts.
_SLOWEST_WINDING_S = 0.1
#: What a motor whose shaft is held moves like: it turns by nothing, and nothing comes back. K²/B is 10⁻¹² Ω.
HELD_SHAFT = {"K": 1e-5, "J": 1e2, "B": 1e2}
#: Runs over whole recordings are kept at so many points: a search along a step looks at a handful and goes back to the
#: best.
_PATHS_KEPT = 8
#: States of the motor itself; the others are effects'.
MOTOR_STATES = ("current_A", "velocity_rad_s", "position_rad")


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch that is simulated freely from an initial state of its own.

    Attributes:
        recording: index of the recording it is from.
        rows: shape (n, 3), see `rollout`.
        measured: shape (n, c).
        valid: shape (n, c).
        x0: shape (nx,), initial state to start from.
        x0_scale: shape (nx,), size of that state over the recording.
        begin: index of its first sample in the recording.
    """

    recording: int
    rows: F64
    measured: F64
    valid: NDArray[np.bool_]
    x0: F64
    x0_scale: F64
    begin: int = 0


@dataclass(frozen=True)
class Problem:
    """Plant, data and which parameters are free.

    Attributes:
        plant: the model.
        channels: measured channels, c of them.
        segments: the data.
        free: names of the shared free parameters.
        local: names of the free parameters that every recording has for itself.
        given: coordinate of every parameter that is not free.
        recordings: how many there are.
        exact: derivatives from compiled sensitivities; False: by differences.
        own_states: states that a segment begins with freely, where derivatives are differences.
        whole: per recording (x0, rows) of a run over all of it, from which segments take their other states; empty:
            they begin as their `x0` says.
        blocked: recordings whose shaft is held; what it would do is no part of them.
    """

    plant: PlantModel
    channels: tuple[str, ...]
    segments: tuple[Segment, ...]
    free: tuple[str, ...]
    local: tuple[str, ...]
    given: Mapping[str, float]
    recordings: int
    exact: bool = True
    own_states: tuple[str, ...] = MOTOR_STATES
    whole: tuple[tuple[F64, F64], ...] = ()
    blocked: frozenset[int] = frozenset()

    @cached_property
    def n_shared(self) -> int:
        return len(self.free)

    @cached_property
    def n_unknowns(self) -> int:
        per_recording = len(self.local) * self.recordings
        return self.n_shared + per_recording + len(self.plant.states) * len(self.segments)

    @cached_property
    def bounds(self) -> tuple[F64, F64]:
        """Lower and upper bound of every unknown, shape (unknowns,) each."""
        table = {p.name: p for p in self.plant.parameters}
        low, high = np.full(self.n_unknowns, -np.inf), np.full(self.n_unknowns, np.inf)
        for k, name in enumerate(self.parameter_of_column):
            p = table[name]
            low[k], high[k] = (np.log(p.lower), np.log(p.upper)) if p.transform == "log" else (p.lower, p.upper)
        return low, high

    @cached_property
    def is_phase(self) -> NDArray[np.bool_]:
        """Shape (unknowns,): angles that an effect's wave begins at."""
        phases = [name.startswith("phi_") for name in self.parameter_of_column]
        return np.array(phases + [False] * (self.n_unknowns - len(phases)))

    def bounds_at(self, unknowns: F64) -> tuple[F64, F64]:
        """The bounds with these unknowns: without a measured current, L's upper one follows R."""
        low, high = self.bounds
        if "L" not in self.free or "current_A" in self.channels or self.plant.drive != "voltage":
            return low, high
        at, high = self.free.index("L"), high.copy()
        R = unknowns[self.free.index("R")] if "R" in self.free else self.given["R"]
        high[at] = min(high[at], max(R + np.log(_SLOWEST_WINDING_S), low[at]))
        return low, high

    @cached_property
    def parameter_of_column(self) -> tuple[str, ...]:
        """Names of the unknowns that are parameters, in order."""
        return (*self.free, *(name for _ in range(self.recordings) for name in self.local))

    @cached_property
    def logarithmic(self) -> NDArray[np.bool_]:
        """Which unknowns are logarithms, shape (unknowns,)."""
        table = {p.name: p for p in self.plant.parameters}
        out = np.zeros(self.n_unknowns, dtype=bool)
        out[: len(self.parameter_of_column)] = [table[n].transform == "log" for n in self.parameter_of_column]
        return out

    def columns(self, index: int) -> NDArray[np.intp]:
        """Which unknowns act on a segment: shared, its recording's own, its initial state; shape (k,)."""
        return self._columns[index]

    @cached_property
    def _columns(self) -> tuple[NDArray[np.intp], ...]:
        return tuple(self._columns_of(k) for k in range(len(self.segments)))

    def _columns_of(self, index: int) -> NDArray[np.intp]:
        recording = self.segments[index].recording
        n_local, n_x = len(self.local), len(self.plant.states)
        own = self.n_shared + n_local * recording
        state = self.n_shared + n_local * self.recordings + n_x * index
        parts = (np.arange(self.n_shared), np.arange(own, own + n_local), np.arange(state, state + n_x))
        return np.concatenate(parts)

    def start(self, coordinates: Mapping[str, float]) -> F64:
        """The vector of unknowns with these parameters and the segments' own initial states."""
        parameters = [coordinates[name] for name in self.parameter_of_column]
        return np.concatenate([parameters, *[s.x0 for s in self.segments]])

    def with_parameters(self, unknowns: F64, coordinates: Mapping[str, float]) -> F64:
        """The same initial states with other parameters."""
        out = unknowns.copy()
        out[: len(self.parameter_of_column)] = [coordinates[name] for name in self.parameter_of_column]
        return out

    def coordinates(self, unknowns: F64, recording: int) -> F64:
        """The plant's parameter vector for a recording, shape (np,)."""
        own = self.n_shared + len(self.local) * recording
        values = dict(zip(self.free, unknowns, strict=False))
        values |= dict(zip(self.local, unknowns[own : own + len(self.local)], strict=True))
        return np.array([values[n] if n in values else self.given[n] for n in self.plant.parameter_names])

    def mean_coordinates(self, unknowns: F64) -> F64:
        """The same of all recordings, shape (np,): of offsets that every one has for itself the mean."""
        return np.asarray(np.mean([self.coordinates(unknowns, k) for k in range(self.recordings)], axis=0))

    def acting(self, unknowns: F64, recording: int) -> F64:
        """The plant's parameter vector that a recording is simulated with, shape (np,)."""
        q = self.coordinates(unknowns, recording)
        if recording in self.blocked:
            for name, value in HELD_SHAFT.items():
                q[self.plant.parameter_names.index(name)] = np.log(value)
        return q

    @cached_property
    def of_the_motion(self) -> NDArray[np.intp]:
        """Which of a segment's columns are parameters that a held shaft does not show, shape (·,)."""
        return np.flatnonzero([name in HELD_SHAFT for name in (*self.free, *self.local)])

    def initial_state(self, unknowns: F64, index: int) -> F64:
        """Shape (nx,)."""
        return np.array(self.initial_states(unknowns)[index])

    def carried(self, unknowns: F64) -> list[F64 | None]:
        """Per segment the states as a run over the whole recording has them at its first sample, shape (nx,)."""
        if not self._carries:
            return [None] * len(self.segments)
        recordings = range(len(self.whole))
        key = b"".join(self.acting(unknowns, recording).tobytes() for recording in recordings)
        if key not in self._known:
            paths = [self.paths([unknowns], recording)[0] for recording in recordings]
            while len(self._known) >= _PATHS_KEPT:
                self._known.pop(next(iter(self._known)))
            self._known[key] = [paths[s.recording][s.begin] for s in self.segments]
        return list(self._known[key])

    @cached_property
    def _known(self) -> dict[bytes, list[F64]]:
        """What `carried` has found, by the parameters that it was found with: initial states change nothing of it."""
        return {}

    @cached_property
    def _carries(self) -> bool:
        """Whether segments take states from a run over the whole recording."""
        return bool(self.whole) and not set(self.plant.state_names) <= set(self.own_states)

    def paths(self, points: Sequence[F64], recording: int) -> list[dict[int, F64]]:
        """States of that run at each of several points, shape (nx,), by the samples that the recording's segments begin
        with; empty where none are taken from it."""
        if not self._carries:
            return [{} for _ in points]
        x0, rows = self.whole[recording]
        q = np.stack([self.acting(unknowns, recording) for unknowns in points])
        begins = sorted({s.begin for s in self.segments if s.recording == recording})
        states = free_states(self.plant, self.channels, q, x0, rows, np.array(begins, dtype=np.intp))
        return [dict(zip(begins, of, strict=True)) for of in states]

    def initial_states(self, unknowns: F64) -> F64:
        """Of all segments, shape (segments, nx)."""
        return unknowns[len(self.parameter_of_column) :].reshape(len(self.segments), len(self.plant.states))

    def starts(self, unknowns: F64, carried: Sequence[F64 | None]) -> F64:
        """The segments' initial states, shape (segments, nx): their own, and what is carried."""
        out = self.initial_states(unknowns).copy()
        others = [k for k, name in enumerate(self.plant.state_names) if name not in self.own_states]
        for x0, there in zip(out, carried, strict=True):
            if there is not None:
                x0[others] = there[others]
        return out

    @cached_property
    def alike(self) -> tuple[tuple[int, NDArray[np.intp], F64], ...]:
        """Segments that are simulated at once: of one recording and one length. Recording, numbers, rows, shape
        (k, n, 3)."""
        kinds = alike((s.recording, len(s.rows)) for s in self.segments)
        return tuple(
            (recording, np.array(which), np.stack([self.segments[k].rows for k in which]))
            for (recording, _), which in kinds.items()
        )

    @cached_property
    def measured(self) -> tuple[tuple[F64, NDArray[np.bool_]], ...]:
        """What was measured in each of `alike`, and where, shapes (k, n, c)."""
        chosen = [[self.segments[k] for k in which] for _, which, _ in self.alike]
        return tuple((np.stack([s.measured for s in one]), np.stack([s.valid for s in one])) for one in chosen)

    def residuals(self, unknowns: F64, starts: F64) -> tuple[F64, ...]:
        """Measured minus simulated, per segment, shape (n, c); 0 where not valid.

        Args:
            starts: see `starts`.
        """
        out: dict[int, F64] = {}
        for (of, which, rows), (measured, valid) in zip(self.alike, self.measured, strict=True):
            shown = free_runs(self.plant, self.channels, self.acting(unknowns, of), starts[which], rows)
            out |= dict(zip(which.tolist(), np.where(valid, measured - shown, 0.0), strict=True))
        return tuple(out[k] for k in sorted(out))

    @cached_property
    def state_prior(self) -> tuple[F64, F64]:
        """Mean and inverse variance of the unknowns' prior: zero weight but for initial states."""
        mean, weight = np.zeros(self.n_unknowns), np.zeros(self.n_unknowns)
        for k, segment in enumerate(self.segments):
            where = self.columns(k)[-len(self.plant.states) :]
            mean[where] = segment.x0
            weight[where] = 1.0 / (_STATE_PRIOR * segment.x0_scale) ** 2
        return mean, weight

    @cached_property
    def sample_period_s(self) -> float:
        """Usual distance of two samples, s."""
        return float(np.median(np.concatenate([s.rows[:, STEP] for s in self.segments])))

    @cached_property
    def counts(self) -> F64:
        """Valid samples of each channel, shape (c,)."""
        return np.asarray(np.sum([s.valid.sum(axis=0) for s in self.segments], axis=0), dtype=np.float64)

    @cached_property
    def spread(self) -> F64:
        """RMS of each measured channel about its mean, shape (c,): what a model that explains nothing leaves; 1 where
        there is no sample."""
        out = []
        for k in range(len(self.channels)):
            values = np.concatenate([s.measured[s.valid[:, k], k] for s in self.segments])
            least = 1e-12 * float(np.max(np.abs(values), initial=0.0))
            out.append(max(float(np.std(values)), least, 1e-9) if len(values) else 1.0)
        return np.array(out)
