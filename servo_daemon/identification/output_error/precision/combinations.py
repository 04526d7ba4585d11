"""What a recording determines where it does not determine the parameters: their combinations.

Without a current sensor only the coefficients of ω/v are visible, without a voltage only ratios to K, and so on. The
combinations that mean something to an engineer are listed here; which of them these data determine is computed (a
combination is determined if its gradient has no part along a null direction), not looked up.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servo_daemon.identification.output_error.precision.information import Information
from servo_daemon.parameters import MOTOR_NAMES
from servo_daemon.plant.build import PlantModel
from servo_daemon.samples import F64

#: A combination known worse than this (1 σ, relative) is not worth a line.
_USELESS = 0.5
#: No logarithm is unknown to more, 1 σ: bounds are about 18 apart, from 10⁻⁴ to 10⁴, and evenly spread between them it
#: has 5. So far, and no farther, goes what has no trace in the data.
_AT_MOST = 5.0

#: A parameter of which a combination follows less than this (relative, by its logarithm) has no part in it.
_NO_PART = 1e-2
#: Of `_CANDIDATES`, the first: the coefficients of ω/v = g/(1 + s p + s² q).
_ANSWER = 3

_Values = Mapping[str, float]
_Candidate = tuple[str, str, tuple[str, ...], Callable[[_Values], float]]
_CANDIDATES: tuple[_Candidate, ...] = (
    ("K/(B R + K²)", "rad/(s·V)", ("R", "K", "B"), lambda p: p["K"] / (p["B"] * p["R"] + p["K"] ** 2)),
    (
        "(J R + L B)/(B R + K²)",
        "s",
        MOTOR_NAMES,
        lambda p: (p["J"] * p["R"] + p["L"] * p["B"]) / (p["B"] * p["R"] + p["K"] ** 2),
    ),
    (
        "J L/(B R + K²)",
        "s²",
        MOTOR_NAMES,
        lambda p: p["J"] * p["L"] / (p["B"] * p["R"] + p["K"] ** 2),
    ),
    ("K/R", "N·m/V", ("R", "K"), lambda p: p["K"] / p["R"]),
    ("L/R", "s", ("R", "L"), lambda p: p["L"] / p["R"]),
    ("K²/R + B", "N·m·s/rad", ("R", "K", "B"), lambda p: p["K"] ** 2 / p["R"] + p["B"]),
    ("K²/J", "Ω/s", ("K", "J"), lambda p: p["K"] ** 2 / p["J"]),
    ("J/K", "A·s²/rad", ("K", "J"), lambda p: p["J"] / p["K"]),
    ("B/K", "A·s/rad", ("K", "B"), lambda p: p["B"] / p["K"]),
    ("J/B", "s", ("J", "B"), lambda p: p["J"] / p["B"]),
    ("Tc/K", "A", ("K", "Tc"), lambda p: p["Tc"] / p["K"]),
    ("Tc R/K", "V", ("R", "K", "Tc"), lambda p: p["Tc"] * p["R"] / p["K"]),
    ("TL/K", "A", ("K", "TL"), lambda p: p["TL"] / p["K"]),
    ("TL R/K", "V", ("R", "K", "TL"), lambda p: p["TL"] * p["R"] / p["K"]),
    ("Tg/K", "A", ("K", "Tg"), lambda p: p["Tg"] / p["K"]),
    ("Tg R/K", "V", ("R", "K", "Tg"), lambda p: p["Tg"] * p["R"] / p["K"]),
)


@dataclass(frozen=True, slots=True)
class Combination:
    """A determined combination of parameters, with 1 σ to first order."""

    expression: str
    value: float
    std: float
    unit: str


@dataclass(frozen=True, slots=True)
class VoltageAnswer:
    """How the speed answers the voltage, all that a recording without a current shows of the motor.

    Attributes:
        coefficients: g, p and q of ω/v = g/(1 + s p + s² q).
        covariance: of their relative deviations, shape (3, 3); that of q may be larger than 1, where the winding is
            fast against what is seen.
    """

    coefficients: tuple[Combination, ...]
    covariance: F64


def voltage_answer(plant: PlantModel, q: F64, info: Information, scale: F64) -> VoltageAnswer | None:
    """None where the model has no voltage, or where the data leave one of the three open.

    Args:
        q, info, scale: as for `determined_combinations`.
    """
    if plant.drive != "voltage":
        return None
    root = _within_bounds(info, scale)
    useless = (_USELESS, _USELESS, np.inf)
    found = [
        _combination(plant, q, info, root, scale, c, u) for c, u in zip(_CANDIDATES[:_ANSWER], useless, strict=True)
    ]
    if any(known is None for known, _ in found):
        return None
    coefficients = tuple(known for known, _ in found if known is not None)
    rows = np.array([gradient / c.value for (_, gradient), c in zip(found, coefficients, strict=True)])
    root = rows @ root
    return VoltageAnswer(coefficients, np.asarray(root @ root.T))


def answer_between(
    answer: VoltageAnswer | None, here: _Values, there: _Values, share: float = 1.0
) -> VoltageAnswer | None:
    """The same as little known as two estimates of the same data are apart; None where there is none.

    Args:
        here, there: natural values of all parameters at both.
        share: of the way between them, 1 σ.
    """
    if answer is None:
        return None
    functions = [candidate[3] for candidate in _CANDIDATES[:_ANSWER]]
    return _with_more(answer, share * np.array([[f(there) / f(here) - 1.0] for f in functions]))


def wider_answer(
    answer: VoltageAnswer | None, plant: PlantModel, q: F64, seen: tuple[Sequence[str], F64], added: F64
) -> VoltageAnswer | None:
    """The same less well known; None where there is none, or one of its first two coefficients then means nothing.

    Args:
        q: as for `determined_combinations`.
        seen: names of the coordinates, and their scale.
        added: root of what comes on top of the coordinates' covariance, shape (k, ·).
    """
    if answer is None:
        return None
    names, scale = seen
    rows = np.array(
        [
            _gradient(plant, q, names, scale, c)[1] / _gradient(plant, q, names, scale, c)[0]
            for c in _CANDIDATES[:_ANSWER]
        ]
    )
    return _with_more(answer, rows / scale @ added)


def _with_more(answer: VoltageAnswer, more: F64) -> VoltageAnswer | None:
    """With a root of relative deviations, shape (3, ·), on top; None where one of the first two then means nothing."""
    covariance = answer.covariance + more @ more.T
    share = np.sqrt(covariance.diagonal())
    if share[0] > _USELESS or share[1] > _USELESS:
        return None
    coefficients = tuple(replace(c, std=float(s) * c.value) for c, s in zip(answer.coefficients, share, strict=True))
    return VoltageAnswer(coefficients, covariance)


def determined_combinations(
    plant: PlantModel,
    q: F64,
    answer: VoltageAnswer | None,
    info: Information,
    scale: F64,
    bounded: Collection[int],
) -> tuple[Combination, ...]:
    """Those that the data determine although they leave one of its parameters open.

    Args:
        q: shape (np,), coordinates of the plant's parameters.
        bounded: columns of parameters that are at a bound: a combination that follows one is no more determined.
        answer: the speed's, which does not depend on how friction and back-EMF share the braking.
        scale: as for `information`.
    """
    open_ones = {name for k, name in enumerate(info.names) if info.undetermined[k] or k in bounded}
    seen = {} if answer is None else {c.expression: c for c in answer.coefficients if c.std < _USELESS * c.value}
    out, root = [], _within_bounds(info, scale)
    for candidate in _CANDIDATES:
        names = set(candidate[2])
        if names <= set(plant.parameter_names) and names & open_ones:
            found, gradient = _combination(plant, q, info, root, scale, candidate)
            known = seen.get(candidate[0]) or found
            if known is not None and not any(abs(gradient[k]) > _NO_PART * abs(known.value) for k in bounded):
                out.append(known)
    return tuple(out)


def _combination(
    plant: PlantModel,
    q: F64,
    info: Information,
    root: F64,
    scale: F64,
    candidate: _Candidate,
    useless: float = _USELESS,
) -> tuple[Combination | None, F64]:
    """The combination, None where it is not determined; and its gradient over the scaled coordinates, shape (k,).

    Args:
        root: see `_within_bounds`.
    """
    expression, unit, _, _ = candidate
    value, gradient = _gradient(plant, q, info.names, scale, candidate)
    std = float(np.linalg.norm(gradient @ root))
    determined = 0.0 < std < useless * abs(value)
    return (Combination(expression, value, std, unit) if determined else None), gradient


def _gradient(plant: PlantModel, q: F64, of: Sequence[str], scale: F64, candidate: _Candidate) -> tuple[float, F64]:
    """The combination's value, and its gradient over the scaled coordinates `of`, shape (k,)."""
    _, _, names, function = candidate
    logs = np.array([p.transform == "log" for p in plant.parameters])

    def natural(coordinates: F64) -> dict[str, float]:
        values: F64 = np.where(logs, np.exp(np.where(logs, coordinates, 0.0)), coordinates)
        return dict(zip(plant.parameter_names, values.tolist(), strict=True))

    value, gradient = function(natural(q)), np.zeros(len(of))
    for column, name in enumerate(of):
        if name in names:
            step = 1e-5 * scale[column] * np.eye(len(q))[plant.parameter_names.index(name)]
            gradient[column] = (function(natural(q + step)) - function(natural(q - step))) / 2e-5
    return value, gradient


def _within_bounds(info: Information, scale: F64) -> F64:
    """Root of the covariance of the scaled coordinates, shape (k, ·), with no direction less known than `_AT_MOST`,
    those without a trace included. Without that a combination that the data know to a percent would hang on whether a
    direction that they do not know at all is so to the last digit."""
    directions, s, _ = np.linalg.svd(info.root / scale[:, None], full_matrices=False)
    return np.hstack([directions * (s / np.hypot(1.0, s / _AT_MOST)), _AT_MOST * info.exact.T])
