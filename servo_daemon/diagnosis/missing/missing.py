"""Unmodelled torque and unmodelled voltage: what would have to be added to the balances for the simulation to be right.

    L di/dt = v − R i − K ω − d_V            J dω/dt = K i − B ω − τ_load − d_T

d_T counts like a load torque (positive against positive motion), d_V like a voltage drop. Both walk at random with
intensities that the data choose; a fixed-interval smoother gives them as time series with standard deviations.
Value k holds from sample k to the next.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from servo_daemon.diagnosis.missing.noise_levels import NoiseLevels, Stretch, alive, fit_levels, resolution
from servo_daemon.diagnosis.missing.smoother import Augmented, backward, forward
from servo_daemon.errors import NumericalError
from servo_daemon.identification.output_error import Recording
from servo_daemon.identification.output_error.problem.problem import Problem, Segment
from servo_daemon.identification.output_error.problem.rollout import INPUT, STEP, TIME
from servo_daemon.identification.output_error.problem.setup import make_problem
from servo_daemon.identification.short_runs import found_states_std, has_found_states, short_runs_with_found_states
from servo_daemon.kalman.gaussian import natural_values
from servo_daemon.numerics import white_noise_var
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64, SampleBlock

#: What the signals tell apart. Without a current (or without motion) only the sum of the two is visible, referred to
#: the shaft or to the terminals.
Visible = Literal["torque and voltage", "sum as torque", "sum as voltage", "torque"]


class Fitted(Protocol):
    """A fitted model: an `OutputErrorFit`, or a trial of the search."""

    @property
    def problem(self) -> Problem:
        """Plant and which parameters are free."""

    def coordinates(self, recording: int = 0) -> F64:
        """Parameters of a recording, shape (np,)."""


#: The unknown inputs' spread before the first sample, in shares of the working torque and voltage (chosen; not tried).
_PRIOR = 3.0
#: Initial states are known to this share of their size (chosen; not tried).
_STATE_PRIOR = 3.0


@dataclass(frozen=True)
class SmoothedStretch:
    """A stretch without long gaps, n samples.

    Attributes:
        rows: shape (n, 3 + 2 c), as the passes took them.
        passed: shape (n, ·), the forward pass (`Augmented.columns`).
        z, std: shape (n, n_z), smoothed state and 1 σ (0 for the steps of a delay line).
    """

    rows: F64
    passed: F64
    z: F64
    std: F64


@dataclass(frozen=True)
class Missing:
    """Unmodelled torque and voltage with their standard deviations, n samples in all.

    Attributes:
        visible: what the signals tell apart; "torque" where current, torque or force is the input.
        time_s: shape (n,), of the capture.
        series, std: "torque" (N·m; N on a linear axis) and "voltage" (V) as far as visible, shapes (n,), with 1 σ.
        states: smoothed plant states by name, shapes (n,).
        input: shape (n,), V, A or N·m, held from each sample on.
        levels: the intensities used.
        size: working torque and voltage of this capture (RMS), by name: what a share is a share of.
        augmented, coordinates: model and parameters of the passes.
        stretches: what the linear response needs.
        resolution: step of each measured channel, 0: none.
        seen: shape (n,). The others are held out and tell where the motor is, nothing else: neither the levels nor any
            statistic of the series counts them.
    """

    visible: Visible
    time_s: F64
    series: Mapping[str, F64]
    std: Mapping[str, F64]
    states: Mapping[str, F64]
    input: F64
    levels: NoiseLevels
    size: Mapping[str, float]
    augmented: Augmented
    coordinates: F64
    stretches: tuple[SmoothedStretch, ...]
    resolution: Mapping[str, float]
    seen: NDArray[np.bool_]

    @property
    def mean_square(self) -> Mapping[str, float]:
        """Mean square of each series over that of the working torque or voltage, where it may be seen."""
        return {n: float(np.mean(np.square(v[self.seen]))) / self.size[n] ** 2 for n, v in self.series.items()}


def missing_inputs(
    fit: Fitted,
    block: SampleBlock,
    *,
    recording: int = 0,
    coordinates: F64 | None = None,
    levels: NoiseLevels | None = None,
    least_walk: Mapping[str, float] | None = None,
    seen: NDArray[np.bool_] | None = None,
    noise_first: bool = False,
) -> Missing:
    """Unmodelled torque and voltage over a capture.

    Args:
        fit: the plant and its parameters.
        block: a capture with the signals that were fitted.
        recording: whose offsets hold, where several were fitted.
        coordinates: parameters to use instead, as in `Missing.coordinates`.
        levels: intensities; None: by maximum likelihood from this capture.
        least_walk: the walks are not slower than this, unit²/s.
        seen: shape (n,): see `Missing.seen`; None: everywhere.
        noise_first: the likelihood may also say that all is noise (`fit_levels`); it may then take for noise of the
            input what the model lacks.

    Raises:
        BadInputError: signals or samples are missing.
        NumericalError: the passes left the range of numbers.
    """
    plant = _with_load(fit.problem.plant)
    q = coordinates_with_load(fit, recording)[1] if coordinates is None else coordinates
    problem = _in_runs(Recording("capture", block), fit.problem.plant, q)
    marks = np.ones(len(block), dtype=bool) if seen is None else seen
    shown = [marks[s.begin : s.begin + len(s.rows)] for s in problem.segments]
    disturbances, visible = _unknown(plant, problem.channels)
    a = Augmented(plant, problem.channels, disturbances)
    size = _sizes(plant, q, problem)
    near = found_states_std(problem, q) if has_found_states(problem) else None
    stretches = [_stretch(a, s, size, near, where) for s, where in zip(problem.segments, shown, strict=True)]
    steps = {
        c: resolution(np.concatenate([s.measured[s.valid[:, k], k] for s in problem.segments]))
        for k, c in enumerate(a.channels)
    }
    if levels is None:
        start, floor = _start(a, problem.segments, size, steps)
        levels = fit_levels(a, q, stretches, start, floor, from_still=noise_first)
    if least_walk:
        levels = replace(levels, walk={d: max(w, least_walk.get(d, 0.0)) for d, w in levels.walk.items()})
    smoothed = tuple(_smooth(a, s, levels.constants(a, q)) for s in stretches)
    z, std = (np.concatenate([getattr(s, name) for s in smoothed]) for name in ("z", "std"))
    time = np.concatenate([s.rows[:, TIME] for s in stretches]) + block.time_s[0]
    return Missing(
        visible=visible,
        time_s=time,
        series={d: z[:, a.n_x + k] for k, d in enumerate(disturbances)},
        std={d: std[:, a.n_x + k] for k, d in enumerate(disturbances)},
        states={name: z[:, k] for k, name in enumerate(plant.state_names)},
        input=np.concatenate([s.rows[:, INPUT] for s in stretches]),
        levels=levels,
        size=size,
        augmented=a,
        coordinates=q,
        stretches=smoothed,
        resolution=steps,
        seen=np.concatenate(shown),
    )


def _in_runs(recording: Recording, plant: PlantModel, q: F64) -> Problem:
    """The whole capture at once; where there is a load behind a gap, in short runs that begin where the load is: a
    filter that comes to an impact early or late has lost it for good."""
    values = natural_values(plant.parameters, q[: len(plant.parameters)])
    return short_runs_with_found_states(make_problem([recording], plant.effects, {}), [recording], values)


def coordinates_with_load(fit: Fitted, recording: int = 0) -> tuple[tuple[str, ...], F64]:
    """Names and coordinates of the plant in which the unmodelled torque has a place, as fitted."""
    plant = _with_load(fit.problem.plant)
    q = np.zeros(len(plant.parameters))
    q[: len(fit.problem.plant.parameters)] = fit.coordinates(recording)
    return plant.parameter_names, q


def _with_load(plant: PlantModel) -> PlantModel:
    """The plant with the parameter TL, through which the unmodelled torque acts."""
    if "TL" in plant.parameter_names:
        return plant
    return plant.with_effects((*plant.effects, "constant_load_torque"))


def _unknown(plant: PlantModel, channels: tuple[str, ...]) -> tuple[tuple[str, ...], Visible]:
    if plant.drive != "voltage":
        return ("torque",), "torque"
    if "current_A" not in channels:
        return ("torque",), "sum as torque"
    if len(channels) == 1:
        return ("voltage",), "sum as voltage"
    return ("torque", "voltage"), "torque and voltage"


def _sizes(plant: PlantModel, q: F64, problem: Problem) -> dict[str, float]:
    """RMS of the torque that the motor works with, N·m, and of the input where that is a voltage, V."""
    p = dict(zip(plant.parameter_names, q, strict=True))
    u = np.concatenate([s.rows[:, INPUT] for s in problem.segments])
    rms = float(np.sqrt(np.mean(u**2))) or 1.0
    if plant.drive == "torque":
        return {"torque": rms}
    if plant.drive == "current":
        return {"torque": float(np.exp(p["K"])) * rms}
    # Without a current the resistance may be anyone's, and K with it: K V / R is of the same scale as what is missing.
    current = rms / float(np.exp(p["R"]))
    if "current_A" in problem.channels:
        measured = float(problem.segments[0].x0_scale[plant.state_names.index("current_A")]) / 2
        current = measured if np.isfinite(measured) and measured > 0 else current
    return {"torque": float(np.exp(p["K"])) * current, "voltage": rms}


def _stretch(
    a: Augmented, segment: Segment, size: Mapping[str, float], near: F64 | None, shown: NDArray[np.bool_]
) -> Stretch:
    """A segment for the passes.

    Args:
        near: shape (nx,), 1 σ of the state that it begins in; None: little is known of that.
        shown: shape (n,), which samples the likelihood may take.
    """
    rows = np.ascontiguousarray(
        np.hstack([segment.rows, np.where(segment.valid, segment.measured, 0.0), segment.valid.astype(float)])
    )
    n_d = len(a.disturbances)
    z0 = np.concatenate([segment.x0, np.zeros(n_d)])
    states = _STATE_PRIOR * segment.x0_scale if near is None else near
    spread = np.concatenate([states, [_PRIOR * size[d] for d in a.disturbances]])
    counted = segment.valid & shown[:, None]
    for k in range(len(a.channels)):
        values = np.where(segment.valid[:, k], segment.measured[:, k], np.nan)
        if resolution(values[segment.valid[:, k]]) > 0:
            counted[:, k] &= alive(values)
    return Stretch(rows, z0, np.diag(spread**2), counted, known=near is not None)


def _start(
    a: Augmented, segments: tuple[Segment, ...], size: Mapping[str, float], steps: Mapping[str, float]
) -> tuple[NoiseLevels, F64]:
    """Where the search for the intensities begins, and the channels' least variances."""
    walk = {d: (0.1 * size[d]) ** 2 for d in a.disturbances}
    u = np.concatenate([s.rows[:, INPUT] for s in segments])
    rms = max(float(np.sqrt(np.mean(u**2))), 1e-12)
    var, floor = {}, []
    for k, c in enumerate(a.channels):
        values = np.concatenate([s.measured[s.valid[:, k], k] for s in segments])
        spread = max(float(np.std(values)), 1e-9)
        least = max(steps[c] ** 2 / 12.0, (1e-6 * spread) ** 2)
        floor.append(least)
        var[c] = float(np.clip(white_noise_var(values), least, (0.1 * spread) ** 2 + least))
    return NoiseLevels(walk, (1e-3 * rms) ** 2, var), np.array(floor)


def _smooth(a: Augmented, s: Stretch, constants: F64) -> SmoothedStretch:
    passed = forward(a).run(s.begin(), constants, s.rows)
    out = backward(a).run(np.zeros(a.n_z + a.n_tri), np.zeros(1), np.ascontiguousarray(passed[::-1]))[::-1]
    if not np.isfinite(out).all():
        raise NumericalError("missing torque and voltage: the smoother left the range of numbers")
    return SmoothedStretch(s.rows, passed, out[:, : a.n_z], np.sqrt(np.maximum(out[:, a.n_z :], 0.0)))


__all__ = ["STEP", "Missing", "NoiseLevels", "SmoothedStretch", "Visible", "missing_inputs"]
