"""Hand-over of the prior: what a tracker with another model takes over from the one that ran before it.

The exchange of a model must neither forget the motor nor carry on what the lack of an effect has biased. A filter
mostly knows when it is biased: what the model lacks costs the parameters it touches their qualification. So what is
qualified is kept, a little widened, what is not is found anew, and what a diagnosis has fitted with the new effect wins
over both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.tracking.plan.parameter_masks import Mask

#: Value and 1 σ (None: not known) in the parameter's unit.
StartValue = tuple[float, float | None]


@dataclass(frozen=True, slots=True)
class PriorTransfer:
    """Prior and slow states for the new filter.

    Attributes:
        known: coordinates and covariance of parameters that the new tracker estimates; those that are missing it has to
            find.
        sure: those among them that were qualified; they stay so as long as their standard deviation allows.
        states: mean and variance of plant states that change slowly and that no sensor shows, by name.
        origin_s: device time from which the filter's time counts.
    """

    known: Gaussian
    sure: frozenset[str]
    states: Mapping[str, tuple[float, float]]
    origin_s: float

    def hand_states_to(self, ekf: Ekf) -> None:
        """Set the slow states of the new filter when it starts."""
        for name, (mean, var) in self.states.items():
            ekf.know_state(name, mean, var)


def trusted_mask(names: Sequence[str], transfer: PriorTransfer | None, saved: Sequence[str]) -> Mask:
    """Parameters that begin as they were known before, shape (n,): from another filter, or from a saved state.

    Args:
        saved: names of the parameters in the saved state: it keeps those only that were qualified.
    """
    sure = saved if transfer is None else transfer.sure
    return np.array([name in sure for name in names])
