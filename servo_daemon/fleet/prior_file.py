"""What drives of a type have in common, as a file: `fleet.parquet`, which a configuration and the training may name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from servo_daemon.errors import BadInputError
from servo_daemon.fleet.tables import read_table, write_table

#: A motor is replaced before its parameters have changed by more: twice the +40 % of R and +80 % of B that the tests'
#: motors age by.
_AGEING = 2.0


@dataclass(frozen=True, slots=True)
class PriorRow:
    """One parameter of a type of drive.

    Attributes:
        parameter, unit: its name, and its unit in SI.
        value: mean over the drives; of positive parameters the exponential of the logarithms' mean.
        std: of that mean.
        spread: standard deviation between drives: of the logarithm where `logarithmic`, else in `unit`.
        logarithmic: whether drives are normal in the logarithm.
        drives: how many it was found from.
    """

    parameter: str
    unit: str
    value: float
    std: float
    spread: float
    logarithmic: bool
    drives: int


def write_prior(path: Path, rows: Sequence[PriorRow]) -> None:
    """Raises BadInputError where it cannot be written."""
    write_table(path, [asdict(row) for row in rows])


def read_prior(path: Path) -> tuple[PriorRow, ...]:
    """Raises BadInputError where it is not a fleet's prior."""
    names = {f.name for f in fields(PriorRow)}
    rows = read_table(path)
    if not rows or any(set(row) != names or None in row.values() for row in rows):
        raise BadInputError(f"{path}: is no fleet.parquet of `servo-daemon fleet fit`")
    return tuple(PriorRow(**row) for row in rows)


def nominal_of(rows: Sequence[PriorRow]) -> dict[str, float]:
    """Start values of a drive of this type."""
    return {row.parameter: row.value for row in rows}


def spread_of(rows: Sequence[PriorRow]) -> float:
    """The factor within which motors are drawn for the training: what drives differ by (3 σ of the parameter that
    differs most), and what ageing adds, `_AGEING`."""
    most = max((row.spread for row in rows if row.logarithmic), default=0.0)
    return max(_AGEING, math.exp(3.0 * most) * math.sqrt(_AGEING))
