"""What noise alone would leave of free runs: the chosen model simulated with sensor and input noise of the levels that
the signals show.

A level comes from no simulation's residual. It is what a filter cannot follow in which torque and voltage that the
model lacks walk as fast as the data want (`missing`): what is wrong in a model goes into these walks. No sensor is
noisier than third differences of its channel allow, in which motion is hardly left, none is more exact than its steps,
and no input is noisier than converters are. Whether a model explains its data is asked with levels at which all may be
noise (`errs_by_noise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servo_daemon.diagnosis.missing.missing import Fitted, Missing
from servo_daemon.diagnosis.missing.noise_levels import NoiseLevels
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.model_discrepancy import if_noise, most_input_var
from servo_daemon.diagnosis.trial.scored import Scored, scored_states
from servo_daemon.diagnosis.trial.split import CHOICE
from servo_daemon.diagnosis.trial.trial import Trial
from servo_daemon.identification.output_error.problem.rollout import INPUT, free_run
from servo_daemon.identification.output_error.solver.solver import solve
from servo_daemon.numerics import THIRD_DIFFERENCE_GAIN
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.samples import F64

#: Errors of free runs that are not called explained: this many times what noise leaves (64 clean captures of the
#: independent generator: 0.65 to 1.29 times, decision 93), and this share of the signal's RMS: where there is next to
#: no noise, a clock's rounding and the simulation's own arithmetic are more than it (chosen).
_BEYOND_NOISE, _LITTLE = 2.0, 1e-3
_SEED = 11
#: The noise is drawn so often for each free run: within one an input's noise adds up to a drift of a few degrees of
#: freedom, and one draw of it is half of its mean square off.
_DRAWS = 4
#: Of squared third differences the largest twentieth, where the motion has edges, is left out, which leaves 75.9 % of
#: the variance of Gaussian noise.
_WITHOUT_EDGES, _LEFT = 0.95, 0.7588


def measured_levels(missing: Missing) -> NoiseLevels:
    """Of the input and of each channel, over the samples that may be seen.

    Args:
        missing: under the model, of the longest recording, over what may be seen.
    """
    channels, stretches = missing.augmented.channels, missing.stretches
    c = len(channels)
    shown = np.split(missing.seen, np.cumsum([len(s.rows) for s in stretches])[:-1])
    variances = {}
    for k, name in enumerate(channels):
        values = [s.rows[where & (s.rows[:, 3 + c + k] > 0), 3 + k] for s, where in zip(stretches, shown, strict=True)]
        least = missing.resolution[name] ** 2 / 12.0
        most = max(third_differences(values), least)
        variances[name] = float(np.clip(missing.levels.channel_var[name], least, most))
    input_var = min(missing.levels.input_var, most_input_var(missing))
    return replace(missing.levels, input_var=input_var, channel_var=variances)


def third_differences(parts: Sequence[F64]) -> float:
    """Variance of white noise with these third differences: the most that a signal's noise can be.

    Args:
        parts: shapes (n,), consecutive samples.
    """
    squares = np.square(np.concatenate([np.diff(x, 3) for x in parts]))
    if len(squares) == 0:
        return float("inf")
    return float(np.mean(squares[squares <= np.quantile(squares, _WITHOUT_EDGES)])) / (THIRD_DIFFERENCE_GAIN * _LEFT)


def errs_beyond_noise(data: Data, fit: Fitted, trial: Trial, missing: Missing) -> bool:
    """Whether free runs of a model err by more than noise does, and by more than a trifle: not knowing why is no reason
    to call it explained.

    Args:
        fit, trial, missing: see `errs_by_noise`.
    """
    return trial.choice.nrmse > _LITTLE and not errs_by_noise(data, fit, trial, missing)


def errs_by_noise(data: Data, fit: Fitted, trial: Trial, missing: Missing) -> bool:
    """Whether free runs of a model err by no more than noise does.

    Args:
        fit, trial: the model fitted to the data, and its free runs.
        missing: of the fit (`longest_missing`).
    """
    floor = noise_floor(measured_levels(if_noise(data, fit, missing)), trial, CHOICE).nrmse
    return trial.choice.nrmse <= _BEYOND_NOISE * floor


def noise_floor(levels: NoiseLevels, trial: Trial, part: int) -> Scored:
    """Errors of the free runs of a part if nothing but noise were left.

    Each is made anew by the trial's model with noise on its input and on its sensors, and scored like a measured one.

    Args:
        levels: of the noise.
        trial: whose parameters hold.
        part: which free runs.
    """
    problem, rng = trial.states(part), np.random.default_rng(_SEED)
    sensor = np.sqrt([levels.channel_var[name] for name in problem.channels])
    exact_zero = any(effects_by_name()[name].exact_zero for name in trial.effects)
    found = solve(problem, problem.start({}), robust=False, max_iterations=8, curved=False)
    unknowns = problem.start({}) if found is None else found.point.unknowns
    segments, starts = [], problem.starts(unknowns, problem.carried(unknowns))
    for segment, x0 in [*zip(problem.segments, starts, strict=True)] * _DRAWS:
        rows = segment.rows.copy()
        noise = rng.normal(0.0, np.sqrt(levels.input_var), len(rows))
        rows[:, INPUT] += np.where(exact_zero & (rows[:, INPUT] == 0.0), 0.0, noise)
        shown, _ = free_run(problem.plant, problem.channels, problem.acting(unknowns, segment.recording), x0, rows)
        segments.append(replace(segment, measured=shown + rng.normal(size=shown.shape) * sensor, x0=x0))
    drawn = scored_states(replace(problem, segments=tuple(segments)))
    squares, counts = (x.reshape(_DRAWS, len(problem.segments), -1) for x in (drawn.squares, drawn.counts))
    return Scored(squares.mean(axis=0), counts[0], problem.spread)
