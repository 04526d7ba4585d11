"""The learned model beside a running filter: every few seconds an estimate of the last window, and what becomes of it.

At first it is only published (shadow). It has proven itself when its estimate of one window closes the balances of the
*next* one, which it has not seen, as well as the filter's values of the same moment do, several times in a row.
From then on it enters the filter as a pseudo-measurement of the parameters' coordinates, with the calibrated covariance
inflated (filter and model see the same samples: their errors are not independent), gated by the distance from the
filter's values. Where the distance is too large for both to be right and the next window's balances say that it is the
filter that is wrong, the filter's covariance is to be widened first. It goes back into the shadow when it loses.

Pure: no I/O, no wall clock. The filter itself is not touched here: `RefreshEstimate.pseudo` says what is to be done.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.learning.examples.drawing import CORE
from servo_daemon.learning.examples.drive import same_rate
from servo_daemon.learning.examples.training import TARGETS
from servo_daemon.learning.features.features import features_of
from servo_daemon.learning.features.window import prepare
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.refresh.champion_challenger import ChampionChallengerTest
from servo_daemon.samples import F64, Quality, SampleBlock, concatenate

#: The calibrated std is taken for so many times as much: filter and model share the samples (chosen; not tried).
_INFLATION = 2.0
#: Gate: mean square of the distance in standard deviations of both together; of R, L, K, J and B chance makes it larger
#: once in 68,000 times (χ² of five above 30).
GATE = 6.0
#: A filter whose variances are all smaller than the model's by this factor has nothing to learn from it: its own would
#: fall by a tenth (1/(1 + 1/9)).
_BETTER = 9.0
#: Friction that is no larger than so many of its standard deviations may be none (Gaussian: once in 740 times), and has
#: no logarithm.
_SEEN = 3.0


@dataclass(frozen=True)
class PseudoMeasurement:
    """What is to enter the filter.

    Attributes:
        names: parameters.
        mean, covariance: of their coordinates (logarithms), shapes (k,) and (k, k).
        widen_std: added 1 σ of the coordinates before, shape (k,); zeros where the filter's covariance can stay.
    """

    names: tuple[str, ...]
    mean: F64
    covariance: F64
    widen_std: F64


@dataclass(frozen=True)
class RefreshEstimate:
    """One window's result.

    Attributes:
        time_s: device time of the window's last sample.
        value, std: by name, SI units; empty where the window was declined.
        familiarity: 0 .. 1; None where there are no features.
        declined: why there is no estimate; "" where there is one.
        mode: "shadow": published only; "trusted": it may enter the filter.
        pseudo: what is to be done with it; None: nothing.
        reason: why nothing is to be done, or why the filter is to be widened; "" else.
        distance: RMS distance from the filter's values in standard deviations; None without a filter.
    """

    time_s: float
    value: Mapping[str, float]
    std: Mapping[str, float]
    familiarity: float | None
    declined: str
    mode: str
    pseudo: PseudoMeasurement | None = None
    reason: str = ""
    distance: float | None = None


class Refresh:
    """Estimates a window every few seconds, and decides whether it may correct the filter.

    Args:
        model: for this drive.
        every_s: from one window's end to the next; no less than a window, so that the next one is new data.
    """

    def __init__(self, model: LearnedModel, every_s: float) -> None:
        self.model = model
        self.every_s = max(every_s, model.spec.window_s)
        self.reset()

    def reset(self) -> None:
        """Begin anew, in the shadow."""
        self._blocks: deque[SampleBlock] = deque()
        self._due_s: float | None = None
        self._channels: tuple[str, ...] = ()
        self._challenge = ChampionChallengerTest()

    @property
    def refuted(self) -> frozenset[str]:
        """Parameters of which the last window's balances say that the filter is wrong, and the model not."""
        return self._challenge.refuted if self._challenge.trusted else frozenset()

    @property
    def mode(self) -> str:
        """ "shadow" or "trusted"."""
        return "trusted" if self._challenge.trusted else "shadow"

    def update(self, block: SampleBlock, estimate: Callable[[], Gaussian | None]) -> RefreshEstimate | None:
        """Take samples; an estimate when a window has become due.

        Args:
            block: the next samples.
            estimate: gives the filter's own parameters in coordinates, as sure as it is of them; None: it has none yet.
                Asked only when a window is due.
        """
        self._keep(block)
        last_s = float(block.time_s[-1])
        if self._due_s is None:
            self._due_s = float(self._blocks[0].time_s[0]) + self.model.spec.window_s
        if last_s < self._due_s:
            return None
        self._due_s = last_s + self.every_s
        return self._estimate(self._window(), last_s, estimate())

    def _keep(self, block: SampleBlock) -> None:
        """The last window's samples; none from before a restart, or with other channels."""
        restarted = bool(np.any(block.quality & int(Quality.TIME_RESTART)))
        backwards = bool(self._blocks) and float(block.time_s[0]) <= float(self._blocks[-1].time_s[-1])
        if restarted or backwards or block.channels != self._channels:
            self._blocks.clear()
            self._due_s, self._channels = None, block.channels
            self._challenge.forget()
        self._blocks.append(block)
        oldest_s = float(block.time_s[-1]) - self.model.spec.window_s
        while len(self._blocks) > 1 and float(self._blocks[0].time_s[-1]) < oldest_s:
            self._blocks.popleft()

    def _window(self) -> SampleBlock:
        whole = concatenate(list(self._blocks))
        period = 1.0 / self.model.spec.rate_hz
        first = float(whole.time_s[-1]) - self.model.spec.window_s + 0.5 * period
        return whole.slice(int(np.searchsorted(whole.time_s, first)), len(whole))

    def _estimate(self, block: SampleBlock, time_s: float, estimate: Gaussian | None) -> RefreshEstimate:
        # A window that is declined says nothing, of the filter neither: what was known stands.
        try:
            window = prepare(block)
        except BadInputError as error:
            return RefreshEstimate(time_s, {}, {}, None, str(error), self.mode)
        if not same_rate(1.0 / window.period_s, self.model.spec.rate_hz):
            text = f"{1.0 / window.period_s:.4g} Hz, the model is for {self.model.spec.rate_hz:g} Hz"
            return RefreshEstimate(time_s, {}, {}, None, text, self.mode)
        p = self.model.predict(features_of(window)[None])
        familiarity, declined = float(p.familiarity[0]), p.declined[0]
        if declined:
            return RefreshEstimate(time_s, {}, {}, familiarity, declined, self.mode)
        filtered = _natural(estimate)
        self._challenge.judge(window, filtered)
        value = dict(zip(TARGETS, p.value[0].tolist(), strict=True))
        std = dict(zip(TARGETS, p.std[0].tolist(), strict=True))
        self._challenge.believe(value, filtered)
        decided = self._compare(value, std, p.correlation, estimate)
        return RefreshEstimate(time_s, value, std, familiarity, "", self.mode, *decided)

    def _compare(
        self, value: Mapping[str, float], std: Mapping[str, float], correlation: F64, estimate: Gaussian | None
    ) -> tuple[PseudoMeasurement | None, str, float | None]:
        """What is to enter the filter, why not (or why it must be widened), and the distance of the two."""
        if estimate is None:
            return None, "the filter has not started", None
        names = [n for n in CORE if n in estimate.names]
        if "Tc" in estimate.names and value["Tc"] > _SEEN * std["Tc"]:
            names.append("Tc")
        if not names:
            return None, "the filter has none of these parameters", None
        own = [TARGETS.index(n) for n in names]
        mean = np.log([value[n] for n in names])
        relative = _INFLATION * np.array([std[n] / value[n] for n in names])
        covariance = correlation[np.ix_(own, own)] * np.outer(relative, relative)
        at = [estimate.names.index(n) for n in names]
        away = mean - estimate.mean[at]
        total = covariance + estimate.covariance[np.ix_(at, at)]
        distance = float(np.sqrt(away @ np.linalg.solve(total, away) / len(names)))
        knows_better = bool(np.all(np.diag(covariance) > _BETTER * np.diag(estimate.covariance)[at]))
        wanted, reason = self._wanted(distance, knows_better)
        if not wanted:
            return None, reason, distance
        # Where the filter is wrong its covariance says nothing: it may be off by what separates the two.
        widen = np.abs(away) * [n in self.refuted for n in names]
        return PseudoMeasurement(tuple(names), mean, covariance, widen), reason, distance

    def _wanted(self, distance: float, knows_better: bool) -> tuple[bool, str]:
        """Whether an estimate is to enter, and why not, or why the filter is to be widened first."""
        if not self._challenge.trusted:
            return False, "shadow: not proven yet"
        if self.refuted:
            return True, "the filter's values leave more of the balances: its covariance is widened"
        if distance**2 <= GATE:
            return not knows_better, "the filter knows all of it better" if knows_better else ""
        return False, f"gated: {distance:.1f} standard deviations from the filter's values"


def _natural(estimate: Gaussian | None) -> dict[str, float] | None:
    """R, L, K, J, B and Tc in SI units; None unless all five are there."""
    if estimate is None or any(n not in estimate.names for n in CORE):
        return None
    mean = dict(zip(estimate.names, estimate.mean.tolist(), strict=True))
    return {n: float(np.exp(mean[n])) for n in TARGETS if n in mean}
