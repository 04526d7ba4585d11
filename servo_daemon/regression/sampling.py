"""Errors that sampling makes in integrals over samples."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from servo_daemon.parameters import MOTOR_NAMES, WINDING_NAMES

#: Lengths of the windows, s: the armature reacts within L/R (a millisecond or so), the shaft within J/B and J R/K²
#: (tens of them); and the fewest samples in one: below, the trapezoidal rule is no good.
SPAN_S = {"armature": 0.02, "shaft": 0.1}
FEWEST_SAMPLES = 12
#: What the last samples say of a parameter is judged over so long, s: its excitation, and the balances (docs/model.md).
WINDOW_S = 5.0
#: What a regression over samples may be off by where the winding is much faster than the sampling, 1 σ (chosen; not
#: tried).
BLIND_STD = {"R": 0.2, "L": 0.5, "K": 0.1, "J": 0.2, "B": 0.5}
#: The same of R and J for each mechanical time constant that a period lasts, and of B as a share of K²/R: from five
#: motors in four motions at 20 to 1000 Hz (`test_a_slow_sampling_is_in_the_regressions_std`).
_GAIN_STD, _LOSS_STD = 0.3, 0.05
#: All of it below 600 Hz, 2 % of it at 1 kHz: there with 1 (13 %) the std of a steady RE 40's J doubles (benchmark
#: `steady`, limit 1.5).
_COARSE_POWER = 2
#: Of L where rows show half of a change of it: it stays nearly where it began, at a datasheet's value.
_INDUCTANCE_STD = 0.3
#: Nothing is known: a decision; ten times the value holds what is a tenth of the truth.
_UNKNOWN_STD = 10.0
#: Periods a time constant of the winding: beyond it nothing of L is left (2e-39), and nothing overflows.
_LARGEST_X = 100.0
#: In place of what is not positive, SI units.
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class Sampling:
    """Period and noise of the samples that integrals are taken over.

    Attributes:
        noise_var: of the measured channels.
        current_step_square: mean square of the current's change from one sample to the next, A².
        period_s: usual distance of two samples.
        samples_per_count: for how long the angle shows one value, on average.
    """

    noise_var: Mapping[str, float]
    current_step_square: float
    period_s: float
    samples_per_count: float

    @property
    def stands(self) -> bool:
        """The shaft does: what holds it may be in no model, and its balance says nothing of what moves it."""
        return self.samples_per_count * self.period_s >= SPAN_S["shaft"]


def settles_between(R: float, L: float, period_s: float) -> bool:
    """Whether the current of such a winding has settled from one sample to the next: what it did meanwhile no integral
    over samples shows."""
    return period_s * R > L


def is_slow(period_s: float) -> bool:
    """Whether the armature's windows are more than twice as long as they should be: below 300 Hz."""
    return FEWEST_SAMPLES * period_s > 2.0 * SPAN_S["armature"]


def settling(R: float, L: float, period_s: float) -> tuple[float, float]:
    """Of a current that approaches the end of each held voltage with the time constant L/R, x = h R/L.

    Returns:
        a = 1/(1 − exp(−x)) − 1/x, ½ .. 1: the current's mean between two samples is i_k + a (i_{k+1} − i_k); and
        (x/2 / sinh(x/2))², 1 .. 0: what of a change of L rows show: the derivative of the L + R h (a − ½) in them.
    """
    x = min(max(period_s * R / max(L, _TINY), 1e-3), _LARGEST_X)
    return 1.0 / -math.expm1(-x) - 1.0 / x, (0.5 * x / math.sinh(0.5 * x)) ** 2


def blind_std(name: str, value: Mapping[str, float], period_s: float) -> float:
    """1 σ of a logarithm that a regression over samples may be off by, whatever its rows say: what the current does
    between two of them it does not see. No less than `BLIND_STD` where the winding settles meanwhile.

    Args:
        value: of all parameters, natural units.
        period_s: usual distance of two samples.
    """
    least = BLIND_STD.get(name, 0.0) * settled_share(value, period_s) * _coarseness(name, period_s)
    return max(least, sampled_std(name, value, period_s))


def sampled_std(name: str, value: Mapping[str, float], period_s: float) -> float:
    """The same for what a regression says of itself, as far as the speed changes from one sample to the next: errors of
    the current's mean move R and J alike, as far as L is not seen (then a is that of another winding), and as far as
    the speed's change is no straight line; K as far as R i is a part of the voltage; B, the difference of the torques
    of steady motion, the more the smaller it is. Windows as long as they should be (`coarse`) have next to none.

    Args:
        value: of all parameters, natural units. 0 where one of R, L, K, J, B is missing; 1 where one is impossible.
        period_s: usual distance of two samples.
    """
    if any(n not in value for n in MOTOR_NAMES):
        return 0.0
    R, L, K, J, B = (value[n] for n in MOTOR_NAMES)
    if min(R, K, J) <= 0.0:
        return _coarseness(name, period_s)
    L, B = max(L, _TINY), max(B, _TINY)
    damping = R * B / K**2  # viscous over electrical
    reach = period_s * (1.0 + damping) * K**2 / (J * R)  # mechanical time constants in a period
    _, seen = settling(R, L, period_s)
    lost = 1.0 - seen + reach * settled_share(value, period_s)
    short = coarse("armature", period_s) ** _COARSE_POWER
    gain = _GAIN_STD * reach * lost * short
    along = gain * min(1.0, damping)
    std = {
        "R": gain,
        "L": _INDUCTANCE_STD * (1.0 / seen - 1.0) * short + gain * period_s * R / (L * seen),
        "K": along,
        "J": gain,
        "B": along + _LOSS_STD * reach * (1.0 + 1.0 / damping) * _coarseness(name, period_s) * short,
    }
    return min(std.get(name, 0.0), _UNKNOWN_STD)


def settled_share(value: Mapping[str, float], period_s: float) -> float:
    """0 .. 1: how far the winding settles from one sample to the next; 0 where R or L is missing."""
    if "R" not in value or "L" not in value:
        return 0.0
    periods = period_s * max(value["R"], _TINY) / max(value["L"], _TINY)
    return periods / (1.0 + periods)


def _coarseness(name: str, period_s: float) -> float:
    return math.sqrt(coarse("armature" if name in WINDING_NAMES else "shaft", period_s))


def of_standing_counts(sampling: Sampling, which: str, covered: float = 1.0) -> dict[str, float]:
    """Variances of the channels' noise as sums over a balance's window see it: a count that stands is one error.

    Args:
        covered: so many samples on one count are allowed for elsewhere.
    """
    alike = min(sampling.samples_per_count, SPAN_S[which] / max(sampling.period_s, 1e-9))
    out = dict(sampling.noise_var)
    if "position_rad" in out:
        out["position_rad"] *= max(alike / covered, 1.0)
    return out


def between_samples(sampling: Sampling, which: str) -> float:
    """What the current does between two samples, as noise of it, A²."""
    return 0.25 * sampling.current_step_square * coarse(which, sampling.period_s)


def coarse(which: str, period_s: float) -> float:
    """0 .. 1: what the current does between two samples is lost on the trapezoidal rule, as far as φ changes meanwhile:
    in amplitude with the square of the share of a sample in the window, all of it in the shortest one."""
    return min(1.0, (FEWEST_SAMPLES * period_s / SPAN_S[which]) ** 4)
