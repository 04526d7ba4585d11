"""How well a model predicts a recording it was not fitted to: free run, and short free runs from measured states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from servo_daemon.identification.output_error.problem.inputs import input_rows
from servo_daemon.identification.output_error.problem.rollout import free_run
from servo_daemon.numerics import sample_period
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64, SampleBlock

#: A measured speed is the slope of a cubic through the angle over this time, s, and at least so many samples.
_SLOPE_S, _SLOPE_SAMPLES = 0.02, 7
#: Length of the short free runs, s.
SHORT_S = 1.0


@dataclass(frozen=True, slots=True)
class Interval:
    """What a channel of the long run is worth, in its unit.

    Attributes:
        half_width: of its 95 % band, rms over the samples.
        inside: share of the samples within the band.
        expected: between what its rms error lies on 95 % of the days on which nothing but friction changed, a little.
    """

    half_width: float
    inside: float
    expected: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Score:
    """RMS errors by channel: of one free run over everything, and of free runs of 1 s each restarted from the measured
    state. `simulated` is the long run, shape (n, c), of `channels`; `intervals` are its own, where they are known."""

    channels: tuple[str, ...]
    rmse: Mapping[str, float]
    rmse_1s: Mapping[str, float]
    simulated: F64
    intervals: Mapping[str, Interval] = field(default_factory=dict)


def measured_speed(block: SampleBlock) -> F64 | None:
    """rad/s, shape (n,): as recorded, or the derivative of the angle by a Savitzky–Golay cubic; None without either."""
    return block.velocity_rad_s if block.position_rad is None else slope(block.position_rad, block.time_s)


def slope(angle: F64, time_s: F64) -> F64:
    """rad/s, shape (n,): of angles, or of differences of angles, by a Savitzky–Golay cubic."""
    period = sample_period(time_s)
    window = max(_SLOPE_SAMPLES, round(_SLOPE_S / period)) | 1
    window = min(window, (len(angle) - 1) | 1)
    if window < 5:
        return np.gradient(angle, time_s)
    from scipy.signal import savgol_filter  # a third of a second of imports

    return np.asarray(savgol_filter(angle, window, 3, deriv=1, delta=period))


def score(block: SampleBlock, plant: PlantModel, q: F64) -> Score:
    """Run the model over a recording.

    Args:
        q: shape (np,), coordinates of the plant's parameters.

    Raises:
        ValueError: a recording without the plant's input or without any measured state.
    """
    found = errors(block, plant, q)
    return Score(found.channels, _rms(found.channels, found.long), _rms(found.channels, found.short), found.simulated)


@dataclass(frozen=True, slots=True)
class Errors:
    """Simulated − measured of one free run over everything, which is `simulated`, and of free runs of 1 s; shapes
    (n, c)."""

    channels: tuple[str, ...]
    simulated: F64
    long: F64
    short: F64


def errors(block: SampleBlock, plant: PlantModel, q: F64) -> Errors:
    """As for `score`, sample by sample."""
    channels, measured, states = measured_start(block, plant, q)
    rows = input_rows(block, plant.drive)
    simulated, path = free_run(plant, channels, q, states[0], rows)
    short = _short_runs(block, plant, q, channels, rows, states, path)
    return Errors(channels, simulated, simulated - measured, short - measured)


def measured_start(block: SampleBlock, plant: PlantModel, q: F64) -> tuple[tuple[str, ...], F64, F64]:
    """Which channels a model is compared with, what was measured of them, shape (n, c), and the states that a free run
    would begin at from each sample, shape (n, nx).

    Raises:
        ValueError: nothing was measured that the model shows.
    """
    speed = measured_speed(block)
    truth: dict[str, F64] = {}
    if plant.drive == "voltage" and block.current_A is not None:
        truth["current_A"] = block.current_A
    if speed is not None:
        truth["velocity_rad_s"] = speed
    if block.position_rad is not None:
        truth["position_rad"] = block.position_rad
    if not truth:
        raise ValueError("nothing measured that the model could be compared with")
    return tuple(truth), np.stack(list(truth.values()), axis=1), _measured_states(block, plant, q, truth)


def _measured_states(block: SampleBlock, plant: PlantModel, q: F64, truth: Mapping[str, F64]) -> F64:
    """Shape (n, nx): what was measured; a current that was not follows from the voltage balance at rest of it."""
    n = len(block)
    states = np.tile([s.initial for s in plant.states], (n, 1))
    for name, values in truth.items():
        if name in plant.state_names:
            states[:, plant.state_names.index(name)] = values
    if "current_A" in plant.state_names and "current_A" not in truth and block.voltage_V is not None:
        R, K = (float(np.exp(q[plant.parameter_names.index(name)])) for name in ("R", "K"))
        omega = truth.get("velocity_rad_s", np.zeros(n))
        states[:, plant.state_names.index("current_A")] = (block.voltage_V - K * omega) / R
    return states


def _short_runs(
    block: SampleBlock,
    plant: PlantModel,
    q: F64,
    channels: tuple[str, ...],
    rows: F64,
    states: F64,
    path: F64,
) -> F64:
    """What is shown when the motion is set to what was measured every second; effects' own states run on."""
    pieces = max(1, round(float(block.time_s[-1] - block.time_s[0]) / SHORT_S))
    edges = np.linspace(0, len(block), pieces + 1).astype(int)
    core = [k for k, name in enumerate(plant.state_names) if name in ("current_A", "velocity_rad_s", "position_rad")]
    out = []
    for begin, end in pairwise(edges.tolist()):
        x0 = path[begin].copy()
        x0[core] = states[begin][core]
        out.append(free_run(plant, channels, q, x0, np.ascontiguousarray(rows[begin:end]))[0])
    return np.concatenate(out)


def _rms(channels: tuple[str, ...], error: F64) -> dict[str, float]:
    """A run that left the range of numbers has an error as large as a number can be, not none."""
    squares = np.mean(
        np.square(np.clip(np.nan_to_num(error, nan=1e150, posinf=1e150, neginf=-1e150), -1e150, 1e150)), axis=0
    )
    return {name: float(np.sqrt(v)) for name, v in zip(channels, squares, strict=True)}
