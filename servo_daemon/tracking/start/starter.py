"""Collects the first samples until the filter can start: where, with which noise, which encoder step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from servo_daemon.conditioning.layout import INPUT, channel
from servo_daemon.kalman.gaussian import Gaussian, to_coordinate
from servo_daemon.numerics import sample_period
from servo_daemon.regression.estimate import RegressionEstimate
from servo_daemon.samples import F64, SampleBlock, concatenate
from servo_daemon.tracking.noise import levels as noise_levels
from servo_daemon.tracking.noise.levels import FEWEST_TO_LEARN, ChannelNoise
from servo_daemon.tracking.plan.settings import Resolutions
from servo_daemon.tracking.plan.signals import SignalPlan
from servo_daemon.tracking.start.starting_point import starting_point, well_known

#: The filter starts no sooner than this after the first sample, s, and waits no longer than that for the regression
#: (decision 32).
_EARLIEST_S, LATEST_S = 1.0, 3.0
#: With a saved state there is only the noise to wait for, s (chosen; half and twice move no tracking figure).
_EARLIEST_SAVED_S = 0.2
#: Ticks kept while there is nothing to start from (two seconds; free within a half and twice:
#: tests/recovery/constants.py).
_TICKS_KEPT = 20
#: An offset that nobody has asked for is small: 1 σ as a share of its scale (decision 16).
BIAS_SHARE = 0.03


@dataclass(frozen=True, slots=True)
class Start:
    """What the filter starts with.

    Attributes:
        parameters: coordinates and covariance.
        noise: of each measured channel.
        position_lsb, input_lsb: steps of encoder and input; 0 where there are none.
        last: the very last sample, for the plant's states.
    """

    parameters: Gaussian
    noise: Mapping[str, ChannelNoise]
    position_lsb: float
    input_lsb: float
    last: SampleBlock


class Starter:
    """Collects one drive's first samples and makes a filter's start of them.

    Args:
        plan: what is to be estimated.
        nominal: given values, natural units.
        regressed: parameters that the regressions can give.
    """

    def __init__(self, plan: SignalPlan, nominal: Mapping[str, float], regressed: tuple[str, ...]) -> None:
        self._plan, self._nominal, self._regressed = plan, nominal, regressed
        self._early: list[SampleBlock] = []

    def reset(self) -> None:
        self._early = []

    def take(
        self,
        tick: SampleBlock,
        elapsed_s: float,
        prior: Gaussian | None,
        found: RegressionEstimate | None,
        resolutions: Resolutions,
        scales: Mapping[str, float],
    ) -> Start | None:
        """A tick's samples, and what is known by now; None while there is still something to wait for.

        Args:
            prior: a saved state, or what another model's filter knew: possibly not of all parameters.
            found: the regression's estimate.
            scales: typical sizes of the bias states.
        """
        self._early.append(tick)
        enough = sum(len(b) for b in self._early) >= FEWEST_TO_LEARN
        if not enough or elapsed_s < (_EARLIEST_SAVED_S if prior is not None else _EARLIEST_S):
            return None
        recording = concatenate(self._early)
        period_s = sample_period(recording.time_s)
        measured = {name: _valid(recording, name) for name in self._plan.measured}
        known = self._known(elapsed_s, found, period_s, prior)
        parameters = None if known is None else self._with_offsets(known, scales)
        if parameters is None or any(len(values) < FEWEST_TO_LEARN for values in measured.values()):
            while len(self._early) > _TICKS_KEPT and len(recording) > 8 * FEWEST_TO_LEARN:
                recording = recording.slice(len(self._early.pop(0)), len(recording))
            return None
        self._early = []
        assert self._plan.plant is not None
        noise = {name: noise_levels.initial_noise(v, resolutions.of(name)) for name, v in measured.items()}
        held_input = INPUT[self._plan.plant.drive]
        return Start(
            parameters,
            noise,
            _step(measured.get("position_rad"), resolutions.position_rad),
            _step(_valid(recording, held_input), resolutions.of(held_input)),
            recording.slice(len(recording) - 1, len(recording)),
        )

    def _known(
        self, elapsed_s: float, found: RegressionEstimate | None, period_s: float, prior: Gaussian | None
    ) -> Gaussian | None:
        """The published and the held parameters; None while there is still something to wait for."""
        plan, given = self._plan, () if prior is None else prior.names
        assert plan.plant is not None
        free = [p for p in plan.plant.parameters if p.name in plan.free and p.name not in given]
        held = [p for p in plan.plant.parameters if p.name in plan.held and p.name not in given]
        if prior is not None and not free and not held:
            return prior
        core = [p.name for p in free if p.transform == "log" and p.name in self._regressed]
        if core and elapsed_s < LATEST_S and not well_known(found, core):
            return None
        start = starting_point(free, None if found is None else found.with_unseen, self._nominal, period_s)
        if start is None:
            return None
        mean = [start.mean, np.array([to_coordinate(p, plan.held[p.name]) for p in held])]
        covariance = [start.covariance, np.zeros((len(held), len(held)))]
        names = (*start.names, *(p.name for p in held))
        if prior is not None:
            mean, covariance = [prior.mean, *mean], [prior.covariance, *covariance]
        return Gaussian((*given, *names), np.concatenate(mean), block_diag(*covariance))

    def _with_offsets(self, known: Gaussian, scales: Mapping[str, float]) -> Gaussian:
        """With the bias states, small and centred on zero."""
        names = self._plan.biases
        var = np.square([BIAS_SHARE * scales[name] for name in names])
        mean = np.concatenate([known.mean, np.zeros(len(names))])
        return Gaussian((*known.names, *names), mean, block_diag(known.covariance, np.diag(var)))


def _valid(block: SampleBlock, name: str) -> F64:
    """The channel's measurements, without what is none."""
    values, valid = channel(block, name)
    return values if valid is None else values[valid]


def _step(values: F64 | None, known: float | None) -> float:
    """Least significant bit; 0 where it is not quantised or not there."""
    if known is not None:
        return known
    return 0.0 if values is None else noise_levels.smallest_step(values)
