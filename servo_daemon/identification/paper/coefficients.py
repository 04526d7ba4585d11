"""Method 1 of the paper: comparing coefficients of the motor's and a process model's transfer function.

    motor:   ω/v = K / (J L s² + (R J + D L) s + D R + K²)          process:  k / (τ₁τ₂ s² + (τ₁ + τ₂) s + 1)

The paper compares without dividing the motor's form by N = D R + K²; it needs "1 = D R + k²" for that, and K_t = k.
Divided,

    k = K/N,      τ₁τ₂ = J L/N,      τ₁ + τ₂ = (R J + D L)/N

and K and D follow from the steady state: K = (v − R i)/ω, D = K i/ω. In both, R is assumed, and J and L are a root of
one quadratic: J = [s ± √(s² − 4 R D p)]/(2 R) with s = N (τ₁ + τ₂), p = N τ₁τ₂. The one with the larger J has the
faster electrical pole. (The paper's D is B everywhere else in this project.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from servo_daemon.errors import BadInputError
from servo_daemon.identification.inverse_dynamics.estimate import Estimate
from servo_daemon.identification.paper.process_model import ProcessModel, fit_process_model
from servo_daemon.identification.paper.steady_sections import SteadyState, steady_state
from servo_daemon.samples import F64, SampleBlock

#: What the paper gives (section 2, method 1): s, s, Ω, N·m/A.
PAPER_TAU_1_S, PAPER_TAU_2_S, PAPER_R, PAPER_K = 1.21e-3, 18.4e-3, 1.5, 4.25e-3
#: What it prints, digits as printed. K = k and R are what was put in.
PAPER_PRINTED: Mapping[str, str] = MappingProxyType(
    {"J": "12.27e-3", "L": "1.81e-3", "D": "0.67", "R": "1.5", "K": "4.25e-3"}
)
_UNITS = {"R": "Ω", "L": "H", "K": "N·m/A", "J": "kg·m²", "B": "N·m·s/rad", "D": "N·m·s/rad"}
#: Relative step of central differences, about ε^⅓: there rounding and curvature cost the same.
_STEP = 1e-5


@dataclass(frozen=True, slots=True)
class Root:
    """One of the quadratic's two answers, kg·m² and H."""

    J: float
    L: float


@dataclass(frozen=True, slots=True)
class PrintedNumber:
    """A number of the paper beside ours.

    Attributes:
        name: J, L, D, R or K. unit: SI.
        printed: as the paper prints it. value: ours, all digits.
        rounded: ours with as many digits as the paper prints.
        digits: how many significant digits the paper prints.
        agreeing: how many of them, from the first on, are ours.
        is_input: it was put in and proves nothing.
    """

    name: str
    unit: str
    printed: str
    value: float
    rounded: str
    digits: int
    agreeing: int
    is_input: bool


@dataclass(frozen=True, slots=True)
class PaperCoefficients:
    """The paper's own numbers redone.

    Attributes:
        values: J, L, D, K, R by name, SI units.
        root, other_root: the quadratic's; `root` has the faster electrical pole and is the paper's.
        comparison: each printed number beside ours.
        note: what the numbers are worth.
    """

    values: Mapping[str, float]
    root: Root
    other_root: Root
    comparison: tuple[PrintedNumber, ...]
    note: str


@dataclass(frozen=True, slots=True)
class Coefficients:
    """The corrected method on a capture.

    Attributes:
        parameters: R (as assumed, std 0), L, K, J, B; without those that are not above 2 σ (without L no J).
        root, other_root: the quadratic's two answers.
        process: the fitted process model.
        steady: where K and B come from.
        gain_ratio: the process model's k over K/(B R + K²): 1 if the motor is linear and R is right.
        notes: for the user.
    """

    parameters: Mapping[str, Estimate]
    root: Root
    other_root: Root
    process: ProcessModel
    steady: SteadyState
    gain_ratio: float
    notes: tuple[str, ...]


def quadratic_roots(sum_s: float, product_s2: float, R: float, D: float, N: float) -> tuple[Root, Root]:
    """(J, L) with J L = N p and R J + D L = N s; first the one with the faster electrical pole R/L.

    Raises:
        BadInputError: no real root: no motor with this R has these time constants.
    """
    s, p = N * sum_s, N * product_s2
    inside = s**2 - 4 * R * D * p
    if inside < 0.0:
        raise BadInputError(
            f"no motor with R = {R:g} Ω has these time constants (sum {sum_s:.4g} s, product {product_s2:.4g} s²): the "
            "assumed R is wrong"
        )
    J = (s + math.sqrt(inside)) / (2 * R)
    if J <= 0.0:
        raise BadInputError(f"time constants with a sum of {sum_s:.4g} s belong to no motor")
    other = D * p / (R * J)  # R J and D L change places
    return Root(J, p / J), Root(other, R * J / D if D else math.inf)


def redo_paper(tau_2_s: float = PAPER_TAU_2_S) -> PaperCoefficients:
    """The paper's comparison under its own normalisation 1 = D R + k².

    Raises:
        BadInputError: the quadratic has no real root.
    """
    D = (1.0 - PAPER_K**2) / PAPER_R
    root, other = quadratic_roots(PAPER_TAU_1_S + tau_2_s, PAPER_TAU_1_S * tau_2_s, PAPER_R, D, 1.0)
    values = {"J": root.J, "L": root.L, "D": D, "K": PAPER_K, "R": PAPER_R}
    note = (
        "K = k and R are inputs, not results; D follows from the assumed R by the normalisation 1 = D R + k² alone, "
        "which forgets to divide by D R + k²"
    )
    comparison = tuple(_beside(name, values[name]) for name in PAPER_PRINTED)
    return PaperCoefficients(MappingProxyType(values), root, other, comparison, note)


def _beside(name: str, value: float) -> PrintedNumber:
    printed = PAPER_PRINTED[name]
    mantissa, _, exponent = printed.partition("e")
    decimals = len(mantissa.partition(".")[2])
    scaled = f"{value / 10.0 ** int(exponent or 0):.{decimals}f}"
    theirs, ours = (text.replace(".", "").lstrip("0") for text in (mantissa, scaled))
    agreeing = 0
    if len(theirs) == len(ours):
        agreeing = next((k for k, (a, b) in enumerate(zip(theirs, ours, strict=True)) if a != b), len(theirs))
    rounded = scaled + (f"e{exponent}" if exponent else "")
    return PrintedNumber(name, _UNITS[name], printed, value, rounded, len(theirs), agreeing, name in ("R", "K"))


def compare_coefficients(blocks: Sequence[SampleBlock], R: float) -> Coefficients:
    """The corrected method: process model and steady state from captures, R assumed.

    Args:
        blocks: whole captures of one motor with voltage, current, and position or speed.
        R: Ω.

    Raises:
        BadInputError: a signal is missing, the voltage never changes, the motion shows no time constants or no steady
            state, or no motor with this R behaves so.
    """
    if not (math.isfinite(R) and R > 0.0):
        raise BadInputError(f"comparing coefficients needs an assumed R greater than zero, not {R:g}")
    absent = [c for c in ("voltage_V", "current_A") if any(getattr(b, c) is None for b in blocks)]
    if absent:
        raise BadInputError(f"comparing coefficients needs {' and '.join(absent)}: this capture has none")
    process = fit_process_model(blocks)
    steady = steady_state(blocks, R, process.sum_s)
    N = steady.B * R + steady.K**2
    root, other = quadratic_roots(process.sum_s, process.product_s2, R, steady.B, N)
    inputs = np.array([steady.K, steady.B, process.sum_s, process.product_s2])
    covariance = np.zeros((4, 4))
    covariance[:2, :2], covariance[2:, 2:] = steady.covariance, process.covariance[1:, 1:]
    by = _slopes(inputs, R)
    J_std, L_std = (float(s) for s in np.sqrt(np.diag(by @ covariance @ by.T)))
    K_std, B_std = (float(s) for s in np.sqrt(np.diag(steady.covariance)))
    found = {"L": (root.L, L_std), "K": (steady.K, K_std), "J": (root.J, J_std), "B": (steady.B, B_std)}
    ratio = process.gain * N / steady.K
    lost = [n for n, (v, s) in found.items() if not v > 2 * s]
    if "L" in lost and "J" not in lost:
        lost.append("J")  # sum and product give both or neither
    notes = _notes(lost, ratio, steady, process)
    parameters = {"R": Estimate(R, 0.0, _UNITS["R"])}
    parameters |= {n: Estimate(v, s, _UNITS[n]) for n, (v, s) in found.items() if n not in lost}
    return Coefficients(MappingProxyType(parameters), root, other, process, steady, ratio, notes)


def _slopes(inputs: F64, R: float) -> F64:
    """d(J, L) / d(K, B, a₁, a₂), shape (2, 4), by differences; towards the side that has real roots."""

    def at(x: F64) -> F64:
        K, B, a1, a2 = (float(v) for v in x)
        root, _ = quadratic_roots(a1, a2, R, B, B * R + K**2)
        return np.array([root.J, root.L])

    out = np.zeros((2, 4))
    for k in range(4):
        step = _STEP * abs(inputs[k]) * np.eye(4)[k]
        try:
            out[:, k] = (at(inputs + step) - at(inputs - step)) / (2 * step[k])
        except BadInputError:  # R J ≈ D L: the roots meet here
            out[:, k] = np.inf
    return out


def _notes(lost: Sequence[str], ratio: float, steady: SteadyState, process: ProcessModel) -> tuple[str, ...]:
    notes = []
    if lost:
        notes.append(f"{', '.join(lost)}: not determined by this capture (below 2 σ, or L is)")
    if steady.source == "slow":
        notes.append("the capture is never steady: K and B are from all its sections, acceleration taken into account")
    if abs(ratio - 1) > 0.05:
        notes.append(
            f"the process model's gain is {ratio:.2f} × that of the steady state: dry friction, a load or a wrong R; "
            "the method knows none of them"
        )
    if process.time_constants_s[0].imag != 0.0:
        notes.append("the motor is underdamped: its time constants are a complex pair, their sum and product real")
    return tuple(notes)
