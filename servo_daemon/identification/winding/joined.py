"""The winding's R, L and K beside a fit of the motion that the measured current drives, with K held.

Every torque is K times a current. So with K held the motion gives J/K, B/K, Tc/K and so on, exactly, and a relative
error of K is one of each: their variances add, and they are correlated with K.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.captures import Capture
from servo_daemon.captures.capture.model import capture_error
from servo_daemon.conditioning.current_moment import moment_std_s, motion_squares
from servo_daemon.identification.output_error import FittedParameter
from servo_daemon.identification.output_error.precision.parameters import BETWEEN_SAMPLES
from servo_daemon.parameters import MOTOR_NAMES, WINDING_NAMES
from servo_daemon.plant.effects import parameter_table
from servo_daemon.regression.winding.estimate import WindingEstimate, as_meant, estimate_winding
from servo_daemon.regression.winding.rows import winding_rows
from servo_daemon.signal_meaning import SignalMeaning

#: Speeds are means over so long, s: an encoder's steps are then no acceleration (as live, a fifth of a tick).
_SPEED_OVER_S = 0.02
#: Parameters of effects that the winding's balance can hold, by effect.
_IN_BALANCE = {"brush_voltage_drop": "Vb", "voltage_sensor_offset": "v0"}


@dataclass(frozen=True, slots=True)
class Winding:
    """What the voltage of captures says.

    Attributes:
        estimate: None where nothing is determined.
        given: of R, L, K those that the user holds.
        B_per_J: 1 σ of B for a J of 1, 1/s: what the moment of the current leaves open.
    """

    estimate: WindingEstimate | None
    given: Mapping[str, float]
    B_per_J: float = 0.0

    def of(self, name: str) -> tuple[float, float] | None:
        """Value and 1 σ; None where it is not determined."""
        return None if self.estimate is None else self.estimate.of(name)

    @property
    def notes(self) -> list[str]:
        """What the user has to know of it, in words."""
        out = ["R, L and K are from the balance of the winding's voltage, the rest from the motion"]
        if self.estimate is None:
            out.append("the winding's balance determines nothing (is a current or a motion missing?)")
        elif self.estimate.extra is not None:
            out.append(f"the winding's balance holds {self.estimate.extra} as well: R and K are less sure")
        return out

    @property
    def K_relative_std(self) -> float:
        """Of K; 0 where it is given, or not determined."""
        K = self.of("K")
        return 0.0 if K is None else K[1] / K[0]


def equivalents_of(
    parameters: Mapping[str, FittedParameter], meaning: SignalMeaning
) -> dict[str, dict[str, dict[str, float | None]]]:
    """R, L and K of the DC motors by the other choices of `publish`, by name; empty where the drive is none of dq.

    Args:
        meaning: of the signals before they were converted.
    """
    return {
        choice: {
            name: {"value": _times(p.value, f), "std": _times(p.std, f)}
            for name, f in factors.items()
            if (p := parameters.get(name)) is not None
        }
        for choice, factors in meaning.equivalents().items()
    }


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def winding_of(
    captures: Sequence[Capture], meaning: SignalMeaning, effects: Sequence[str], fixed: Mapping[str, float]
) -> Winding:
    """Of captures of one motor, in a DC motor's units.

    Args:
        meaning: of their voltage and current.
        fixed: held parameters.
    """
    given = {name: fixed[name] for name in WINDING_NAMES if name in fixed}
    added = [parameter for effect, parameter in _IN_BALANCE.items() if effect in effects]
    best: WindingEstimate | None = None
    for by_position in (True, False):
        rows = [winding_rows(c.block(), meaning, by_position=by_position) for c in captures]
        whole = [r for r in rows if r is not None]
        found = estimate_winding(whole, given, added) if whole else None
        if found is not None and (best is None or found.badness < best.badness):
            best = found
    if best is not None:
        best = as_meant(best, meaning, max(c.sample_period_s for c in captures))
    return Winding(best, given, max(_open_friction(c, meaning) for c in captures))


def _open_friction(capture: Capture, meaning: SignalMeaning) -> float:
    """1 σ of B for a J of 1, 1/s (`conditioning/current_moment.py`)."""
    at = np.arange(0, len(capture), max(1, round(_SPEED_OVER_S / capture.sample_period_s)))
    squares = motion_squares(capture.time_s, capture.position_rad, capture.velocity_rad_s, at)
    if squares is None or squares[0] <= 0.0:
        return 0.0
    return moment_std_s(meaning) * float(squares[1] / squares[0])


def one_meaning(captures: Sequence[Capture], otherwise: SignalMeaning) -> SignalMeaning:
    """Of captures that are fitted together.

    Raises:
        CaptureError: one has signals of another meaning.
    """
    first = captures[0].meaning(otherwise)
    for capture in captures[1:]:
        if capture.meaning(otherwise) != first:
            what = f"its signals do not mean what those of {captures[0].path} do: fit them apart"
            raise capture_error(capture.path, what)
    return first


def joined_parameters(fitted: Mapping[str, FittedParameter], winding: Winding | None) -> dict[str, FittedParameter]:
    """All of the motor's, in the usual order.

    Args:
        fitted: of the motion, with K held at the winding's; None: a fit as any other.
    """
    if winding is None:
        return dict(fitted)
    names = [*MOTOR_NAMES, *(n for n in fitted if n not in MOTOR_NAMES)]
    open_std = {"B": _open_std(fitted, winding)}
    return {name: _joined(name, fitted.get(name), winding, open_std.get(name, 0.0)) for name in names}


def _open_std(fitted: Mapping[str, FittedParameter], winding: Winding) -> float:
    """Of B, beside what the fit says."""
    J = fitted["J"].value if "J" in fitted else None
    return winding.B_per_J * (J or 0.0)


def _joined(name: str, fitted: FittedParameter | None, winding: Winding, open_std: float) -> FittedParameter:
    unit = parameter_table()[name].unit
    if name in winding.given:
        return FittedParameter(winding.given[name], None, unit, "fixed", at_bound=False)
    found = winding.of(name)
    if found is not None:
        return FittedParameter(*found, unit, "estimated", at_bound=False)
    if fitted is None or name in _IN_BALANCE.values():
        return FittedParameter(None, None, unit, "undetermined", at_bound=False)
    if fitted.value is None or fitted.std is None or not is_torque(unit):
        return fitted
    # (Of a mean current nobody knows when in its interval it flowed.)
    share = math.hypot(winding.K_relative_std, BETWEEN_SAMPLES)
    return replace(fitted, std=math.hypot(fitted.std, open_std, fitted.value * share))


def is_torque(unit: str) -> bool:
    """Whether a parameter of this unit goes with K where the current drives the motion: torques, inertias, springs."""
    return unit.startswith(("N", "kg"))


def joined_correlation(
    correlation: Mapping[str, Mapping[str, float]],
    fitted: Mapping[str, FittedParameter],
    winding: Winding | None,
) -> dict[str, dict[str, float]]:
    """Of all determined parameters.

    Args:
        correlation: of the motion's fit, with K held.
        fitted: of the same fit.
    """
    if winding is None or winding.estimate is None:
        return {name: dict(row) for name, row in correlation.items()}
    estimate, motion = winding.estimate, [n for n in correlation if n not in winding.estimate.names]
    names = [*estimate.names, *motion]
    n, m = len(estimate.names), len(names)
    covariance = np.zeros((m, m))
    covariance[:n, :n] = estimate.covariance
    std = np.array([fitted[name].std or 0.0 for name in motion])
    covariance[n:, n:] = np.outer(std, std) * [[correlation[a][b] for b in motion] for a in motion]
    if "B" in motion:
        B = n + motion.index("B")
        covariance[B, B] += _open_std(fitted, winding) ** 2
    if "K" in estimate.names:
        K = estimate.names.index("K")
        slope = np.array([(fitted[x].value or 0.0) / estimate.value[K] * is_torque(fitted[x].unit) for x in motion])
        covariance[n:, n:] += np.outer(slope, slope) * estimate.covariance[K, K]
        covariance[n:, :n] = np.outer(slope, estimate.covariance[K])
        covariance[:n, n:] = covariance[n:, :n].T
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    shares = covariance / np.outer(size, size)
    return {a: dict(zip(names, row, strict=True)) for a, row in zip(names, shares.tolist(), strict=True)}
