"""Whether drives are of one type: a mean between two kinds of motor is nobody's."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servo_daemon.fleet.prior import UNKNOWN
from servo_daemon.samples import F64

#: Types are where a positive parameter has a gap of half its value, and the means on either side differ by so many
#: times what drives of one side do: of 8 to 30 drives whose logarithms are normal with a spread of 20 % one fleet in
#: 2,000 has such a gap in a given parameter (4,000 drawn), with a spread of 10 % none.
_APART, _GAP = 8.0, math.log(1.5)
#: Fewer drives, or a smaller share of the fleet, are strangers (`prior.pool` takes one in ten).
_FEWEST, _SHARE = 2, 0.1
#: Values with a larger standard deviation of their logarithm tell no type.
_VAGUE = 0.2

Group = NDArray[np.intp]


def types_of(y: F64, S: F64, logarithmic: Sequence[bool]) -> tuple[Group, ...]:
    """Numbers of the drives of each type, the largest first; none where all are alike.

    Args:
        y, S: as for `pool`, shape (n, p) and (n, p, p).
        logarithmic: shape (p,): only these columns are compared.
    """
    variance = np.einsum("ikk->ik", S)
    values = np.where(variance < min(_VAGUE**2, UNKNOWN), y, np.nan)[:, np.asarray(logarithmic, dtype=bool)]
    groups, left = [], [np.arange(len(y))]
    fewest = max(_FEWEST, math.floor(_SHARE * len(y)) + 1)
    while left:
        group = left.pop()
        parts = _split(values[group], fewest)
        if parts is None:
            groups.append(group)
        else:
            left += [group[part] for part in parts]
    return tuple(sorted(groups, key=len, reverse=True)) if len(groups) > 1 else ()


def _split(values: F64, fewest: int) -> list[NDArray[np.bool_]] | None:
    """A group parted by the parameter that parts it most; drives without a value there stay with the most."""
    best, cut = _APART, None
    for column in values.T:
        x = np.sort(column[np.isfinite(column)])
        parts = [p for p in np.split(x, np.flatnonzero(np.diff(x) > _GAP) + 1) if len(p) >= fewest]
        if len(parts) > 1:
            free = max(sum(map(len, parts)) - len(parts), 1)
            within = math.sqrt(sum(len(p) * float(p.var()) for p in parts) / free)
            means = np.array([p.mean() for p in parts])
            apart = float(np.diff(means).min()) / max(within, 1e-9)
            if apart > best:
                best, cut = apart, (column, means, int(np.argmax([len(p) for p in parts])))
    if cut is None:
        return None
    column, means, most = cut
    nearest = np.argmin(np.abs(column[:, None] - means), axis=1)
    nearest[np.isnan(column)] = most
    return [nearest == k for k in range(len(means))]
