"""The features: names, units, what they are. The order here is the order of every array of features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

#: Frequency bands of the spectra, evenly spaced in log f from 1 Hz to 0.4 of the sample rate.
BANDS = 5
#: Speed classes of the current that the motion takes.
CLASSES = 3


@dataclass(frozen=True, slots=True)
class Feature:
    """One number of a window.

    Attributes:
        name: as in model files.
        unit: SI; "1" for a ratio.
        scale: "log": positive, learned as a logarithm.
        text: what it is.
    """

    name: str
    unit: str
    scale: Literal["log", "linear"]
    text: str


def _log(name: str, unit: str, text: str) -> Feature:
    return Feature(name, unit, "log", text)


def _linear(name: str, unit: str, text: str) -> Feature:
    return Feature(name, unit, "linear", text)


_UNITS = {"R": "Ω", "L": "H", "K": "N·m/A", "J": "kg·m²", "B": "N·m·s/rad"}

#: The motor's own regression (`regression/motor_rls.py`), with dry friction, load, offset and, where the current flows
#: both ways, a brush drop beside the five.
REGRESSION: tuple[Feature, ...] = (
    *(_log(f"reg_{n}", unit, f"{n} by regression") for n, unit in _UNITS.items()),
    *(_log(f"reg_{n}_std", "1", f"its 1 σ over {n}") for n in _UNITS),
    _linear("reg_Tc_share", "1", "dry friction by regression over K times the current's RMS"),
    _linear("reg_TL_share", "1", "load torque by regression over K times the current's RMS"),
    _linear("reg_Vb_share", "1", "brush drop by regression over the voltage's RMS"),
    _log("reg_tau_e", "s", "L/R by regression"),
    _log("reg_tau_m", "s", "J R/(R B + K²) by regression"),
    _log("reg_gain", "rad/(s·V)", "K/(R B + K²) by regression"),
)

#: The same balances with other columns and over other spans: what changes tells what the model lacks.
BALANCES: tuple[Feature, ...] = (
    _linear("arm_long_R", "1", "log of R over spans of 0.1 s to reg_R"),
    *(_linear(f"arm_plain_{n}", "1", f"log of {n} by plain least squares to reg_{n}") for n in "RLK"),
    *(_linear(f"arm_drop_{n}", "1", f"the same beside a voltage V sgn i, to reg_{n}") for n in "RLK"),
    _linear("arm_drop", "1", "that voltage over the voltage's RMS"),
    _linear("arm_offset", "1", "constant voltage of the armature's balance over the voltage's RMS"),
    _log("arm_left", "1", "what the armature's balance leaves, over the voltage, spans of 0.02 s"),
    _log("arm_left_long", "1", "the same, spans of 0.1 s"),
    _linear("arm_rejected", "1", "what rows of the armature's balance leave that a fit to the others rejects"),
    *(_linear(f"shaft_linear_{n}", "1", f"log of {n} without dry friction to reg_{n}") for n in "JB"),
    *(_linear(f"shaft_long_{n}", "1", f"log of {n} over spans of 0.4 s to reg_{n}") for n in "JB"),
    _linear("shaft_long_Tc", "1", "dry friction over spans of 0.4 s over K times the current's RMS"),
    *(_linear(f"shaft_drag_{n}", "1", f"log of {n} beside c ω|ω| to reg_{n}") for n in "JB"),
    _linear("shaft_drag", "1", "that torque at the speed's RMS over K times the current's RMS"),
    *(
        _linear(f"arm_{when}_{s}", "1", f"log of what the armature's balance leaves if {s} came 4 ms {when}, to now")
        for when in ("late", "early")
        for s in "viw"
    ),
    *(
        _linear(f"shaft_{when}", "1", f"log of what the shaft's balance leaves if the current came 4 ms {when}, to now")
        for when in ("late", "early")
    ),
    _log("shaft_left", "1", "what the shaft's balance leaves, over the current, spans of 0.1 s"),
    _log("shaft_left_long", "1", "the same, spans of 0.4 s"),
    _linear("shaft_rejected", "1", "what rows of the shaft's balance leave that a fit to the others rejects"),
    _linear("shaft_delay", "s", "by how much the current comes late in the shaft's balance"),
    _log("shaft_left_linear", "1", "the same without dry friction, spans of 0.1 s"),
)

_PAIRS = {"v_i": ("current over voltage", "A/V"), "v_w": ("speed over voltage", "rad/(s·V)")}
_PAIRS["i_w"] = ("speed over current", "rad/(s·A)")
SPECTRUM: tuple[Feature, ...] = (
    *(_linear(f"power_{s}_{b}", "1", f"log share of {s} in band {b}") for s in "viw" for b in range(1, BANDS + 1)),
    *(_log(f"gain_{p}_{b}", u, f"gain, {t}, band {b}") for p, (t, u) in _PAIRS.items() for b in range(1, BANDS + 1)),
    *(_linear(f"lag_{p}_{b}", "rad", f"phase lag, {t}, band {b}") for p, (t, _) in _PAIRS.items() for b in range(1, 4)),
    *(
        _linear(f"coherence_{p}_{b}", "1", f"coherence, {t}, band {b}")
        for p, (t, _) in _PAIRS.items()
        for b in range(1, BANDS + 1)
    ),
    _log("floor_i", "1", "current's noise at the top of the spectrum over its RMS"),
    _log("decay_i", "s", "the current's autocorrelation falls to a half within"),
    _log("decay_w", "s", "the speed's autocorrelation falls to a half within"),
)

STATISTICS: tuple[Feature, ...] = (
    _log("rms_v", "V", "RMS of the voltage"),
    _log("rms_i", "A", "RMS of the current"),
    _log("rms_w", "rad/s", "RMS of the speed"),
    _log("rms_a", "rad/s²", "RMS of the acceleration"),
    *(_linear(f"mean_{s}", "1", f"mean of {s} over its RMS") for s in "viw"),
    *(_log(f"crest_{s}", "1", f"peak of {s} over its RMS") for s in "viw"),
    *(_linear(f"skew_{s}", "1", f"skewness of {s}") for s in "viw"),
    *(_log(f"kurtosis_{s}", "1", f"kurtosis of {s}") for s in "viw"),
    _linear("still", "1", "share of time at less than 2 % of the greatest speed"),
    _linear("saturated", "1", "share of samples at a limit of the drive"),
    _log("encoder_step", "1", "the encoder's step over the speed's RMS times 10 ms"),
)

MOTION: tuple[Feature, ...] = (
    _log("ratio_v_i", "Ω", "Σ v i / Σ i²: apparent resistance, back-EMF included"),
    _log("ratio_v_w", "V·s/rad", "Σ v ω / Σ ω²: voltage a speed takes"),
    _log("ratio_i_w", "A·s/rad", "Σ i ω / Σ ω²: current a speed takes, B/K without dry friction"),
    _log("ratio_i_a", "A·s²/rad", "Σ i α / Σ α²: current an acceleration takes, J/K"),
    *(
        _linear(f"current_at_{c}", "1", f"mean current with the motion in speed class {c}")
        for c in range(1, CLASSES + 1)
    ),
    _linear("direction", "1", "what the current has on top in positive motion, over its RMS"),
    _log("reversals", "1/s", "changes of direction a second, and one more in the window"),
    _linear("reversal_i", "1", "step of the current across a reversal, in the direction of motion, over its RMS"),
    _log("ripple_i", "1", "current faster than 5 ms that the voltage does not explain, over its RMS"),
    _log("balance_power", "1", "Σ v i over Σ v² / (Σ v i / Σ i²): how resistive it looks"),
)

FEATURES: tuple[Feature, ...] = (*REGRESSION, *BALANCES, *SPECTRUM, *STATISTICS, *MOTION)
NAMES: tuple[str, ...] = tuple(f.name for f in FEATURES)
#: Changes when any feature is computed otherwise: part of a model file's identity.
VERSION = 3
