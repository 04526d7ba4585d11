"""What the filter is given of each sample, as one compiled step: the sample in the filter's layout, values that are no
measurement left out, repeated ones doubted.

A count that stands still repeats one error, it does not average it: the k-th sample alike weighs 1/(2 k (k − 1)), so
that however long it stands all of them together say little more than the first. That first one, after m samples on
the count before it, is nowhere in the middle of its count: the shaft has just come over the edge, at some q/m a
sample (q: the count). Taken for the middle it would be ahead of the shaft by up to half a count, always the way the
shaft moves. It is taken for q/(2 m) beyond the edge, (q/2)(1 − 1/m) behind the middle. (All samples of a count alike
have no such error: one is as far ahead as another is behind. It is the weights that bring it.) A step of the input's
converter that is held for long is one error as well, and its effect adds up.

An input that leaps and leaps back within one sample, far beyond what it usually does, is rather misread than applied.
With the next sample, which tells, comes the correction that puts it between its neighbours; the filter takes it for as
uncertain as it leapt far.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import casadi as ca

#: So many samples on one step of the input's converter are counted as one error.
_MOST_ALIKE = 100.0
#: Most by which a standing encoder's variance is raised: 5000 samples on one count.
_MOST_DOUBT = 5e7
#: A channel whose repetitions nobody doubts, and a value that none is alike.
NEVER, NO_VALUE = 1e300, 1e300


@dataclass(frozen=True, slots=True)
class LayoutStep:
    """Where everything is in the flat vectors; c measured channels, the input before them.

    state:     time of the last sample | input held | (last value, how many alike) per channel | input before that held
    constants: start of time | variance of the input's step | variance where the input is unknown | the largest leap
               that is none | (largest possible value, half its step, from how many alike on it is doubted) per channel
    sample:    time | (value, whether the drive calls it valid) per channel
    output:    a sample as `ekf_layout.EkfLayout` has it
    """

    channels: int

    @property
    def n_state(self) -> int:
        return 3 + 2 * (1 + self.channels)

    @property
    def n_constants(self) -> int:
        return 4 + 3 * (1 + self.channels)

    @property
    def n_sample(self) -> int:
        return 1 + 2 * (1 + self.channels)


@cache
def build_layout_step(channels: int) -> ca.Function:
    """For `SampleLoop`.

    Args:
        channels: how many are measured.
    """
    lay = LayoutStep(channels)
    state, const = ca.SX.sym("state", lay.n_state), ca.SX.sym("const", lay.n_constants)
    sample = ca.SX.sym("sample", lay.n_sample)
    kept, shown = [], []
    for k in range(1 + channels):
        limit, half_step, least = ca.vertsplit(const[4 + 3 * k : 7 + 3 * k])
        valid = ca.logic_and(sample[2 + 2 * k] > 0, ca.fabs(sample[1 + 2 * k]) <= limit)  # which a NaN is not
        value = ca.if_else(valid, sample[1 + 2 * k], 0.0)
        last, before = state[2 + 2 * k], state[3 + 2 * k]
        alike = ca.if_else(ca.fabs(value - last) <= half_step, before + 1.0, 1.0)
        # What is no measurement is passed over: the count that stood before it stands after it.
        kept += [ca.if_else(valid, value, last), ca.if_else(valid, alike, before)]
        value -= _ahead(value - last, before, half_step) * (alike <= 1.0)
        doubt = ca.if_else(alike >= least, ca.fmin(2.0 * alike * (alike - 1.0), _MOST_DOUBT), 1.0)
        shown.append((value, valid, doubt, alike))
    value, valid, _, alike = shown[0]
    held = ca.if_else(valid, value, state[1])
    extra = ca.if_else(valid, const[1] * ca.fmin(alike - 1.0, _MOST_ALIKE), const[2])
    measured = [x for value, valid, doubt, _ in shown[1:] for x in (value, valid, doubt)]
    row = ca.vertcat(sample[0] - const[0], sample[0] - state[0], held, extra, *measured, _misread(state, const, held))
    return ca.Function("step", [state, const, sample], [ca.vertcat(sample[0], held, *kept, state[1]), row])


def _misread(state: ca.SX, const: ca.SX, after: ca.SX) -> ca.SX:
    """What is to be added to the input that was held until now; 0 where it was no lone leap."""
    before, held = state[-1], state[1]
    there, back = held - before, held - after
    leapt = ca.fmin(ca.fabs(there), ca.fabs(back)) > const[3]
    lone = ca.logic_and(ca.logic_and(leapt, there * back > 0), before < NO_VALUE)
    return ca.if_else(lone, (before + after) / 2.0 - held, 0.0)


def _ahead(moved: ca.SX, before: ca.SX, half_step: ca.SX) -> ca.SX:
    """By how much a count's middle is ahead of a shaft that has just come to it.

    Args:
        moved: by how much the count has changed; beyond one step it says nothing of where in the count the shaft is.
        before: samples on the count before.
    """
    from_middle = half_step * (1.0 - 1.0 / ca.fmax(before, 1.0))
    return ca.if_else(ca.fabs(moved) <= 3.0 * half_step, ca.sign(moved) * from_middle, 0.0)
