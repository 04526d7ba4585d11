"""Regression cross-check: where R and K lie along a line on which the balance hardly changes, the filter's values are
published only after they agreed with the regressions'.

On slow motion of a motor with much friction current and speed are all but proportional: a larger R with a smaller K
explains the same voltage, to a thousandth. A filter that began beside the truth goes along such a line by what its
derivatives at wrong values seem to tell it, and is sure of where it stops (K 49 % off at 25 σ). The regressions take
no derivatives: they say that they hardly know, and what they do say is right to a few percent. So a filter whose values
were never near theirs has lost its way. Once it was near, it is the surer of the two, and the regression, which
remembers for longer, may fall behind a motor that ages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from servo_daemon.regression.estimate import RegressionEstimate

#: Errors of two parameters go together from this correlation on (decision 30).
_ONE_LINE = 0.9
#: Near: by no more than this, and so many of the filter's standard deviations; of a logarithm (decision 30).
_NEAR, _STDS = 0.03, 2.0
#: What may lie on the line with K.
_BESIDE = ("R", "J", "B")


class RegressionCrossCheck:
    """Compares one filter's values with the regressions' until they have once agreed.

    Attributes:
        done: its values have been near the regression's, of all parameters on the line at once.
    """

    def __init__(self) -> None:
        self.done = False

    def unconfirmed(
        self,
        found: RegressionEstimate,
        value: Mapping[str, float],
        std: Mapping[str, float],
        blind: Mapping[str, float],
    ) -> frozenset[str]:
        """Names of all parameters where R and K are on one line and nothing speaks for the filter's values: the shaft's
        are in units of K, and L comes as L/R.

        Args:
            value: the filter's, natural units.
            std: of their logarithms.
            blind: 1 σ of the logarithms that the regression may be off by between samples.
        """
        line = () if self.done else on_one_line(found)
        if not line:
            return frozenset()
        self.done = all(
            found.value[k] > 0.0
            and abs(math.log(value[name] / float(found.value[k]))) < _NEAR + _STDS * std[name] + blind[name]
            for name, k in line
        )
        if self.done:
            return frozenset()
        return frozenset(found.names)


def on_one_line(found: RegressionEstimate) -> tuple[tuple[str, int], ...]:
    """K, R, and what is on the line with them, with their indices; empty where R and K are identifiable."""
    if not {"R", "K"} <= set(found.names):
        return ()
    at = found.names.index("K")
    together = np.abs(found.covariance[at]) > _ONE_LINE * found.std * found.std[at]
    line = [(n, k) for k, n in enumerate(found.names) if n in _BESIDE and together[k]]
    return (("K", at), *line) if any(n == "R" for n, _ in line) else ()
