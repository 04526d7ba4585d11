"""What the filter is given of each sample, as one compiled step: the sample in the filter's layout, values that are no
measurement left out, repeated ones doubted.

A count that stands still repeats one error, it does not average it: the k-th sample alike weighs 1/(2 k (k − 1)), so
that however long it stands all of them together say little more than the first. That first one, after m samples on
the count before it, is nowhere in the middle of its count: the shaft has just come over the edge, at some q/m a
sample (q: the count). Taken for the middle it would be ahead of the shaft by up to half a count, always the way the
shaft moves. It is taken for q/(2 m) beyond the edge, (q/2)(1 − 1/m) behind the middle. (All samples of a count alike
have no such error: one is as far ahead as another is behind. It is the weights that bring it.) A step of the input's
converter that is held for long is one error as well, and its effect adds up.

A spike of the input, which goes and comes back within one sample far beyond what it usually does, is rather misread
than applied.
With the next sample, which tells, comes the correction that puts it between its neighbours; the filter takes it for as
uncertain as it went far. A reading that does so where the input does not is not believed at once: if it was no spike,
the next says so.

A measured current or torque is no held input. Where the steps are long its mean over one is that of the curve through
the last four instants (the implicit Adams formula of that order: Hairer, Nørsett & Wanner, *Solving Ordinary
Differential Equations I*, sec. III.1), and it changes across the step, which moves the angle.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import casadi as ca

from servo_daemon.kalman.layout import SPIKE
from servo_daemon.samples import GAP_FACTOR

#: So many samples on one step of the input's converter are counted as one error (chosen; not tried).
_MOST_ALIKE = 100.0
#: Most by which a standing encoder's variance is raised: 5000 samples on one count.
_MOST_DOUBT = 5e7
#: A spike is so many times the change before it (decision 11).
_APART = 4.0
#: A channel whose repetitions nobody doubts, and a value that none is alike.
NEVER, NO_VALUE = 1e300, 1e300
#: In shorter steps, s, a signal runs straight: of a motion of 5 Hz the bend is less than 0.1 % of it, (ω h)²/12, and a
#: command that a controller holds for each of its samples has none (on EMPS, at 1 kHz, it cost an eighth of the error).
BENDS_S = 3e-3


@dataclass(frozen=True, slots=True)
class LayoutStep:
    """Where everything is in the flat vectors; c measured channels, the input before them.

    state:     time of the last sample | input held | (last value, how many alike, value before) per channel | of an
               input that is not held: the two before the last one, the last two steps (s)
    constants: start of time | variance of the input's step | variance where the input is unknown | (largest possible
               value, half its step, from how many alike on it is doubted, the largest change that is no spike) per
               channel
    sample:    time | (value, whether the drive calls it valid) per channel
    output:    a sample as `kalman.layout.EkfLayout` has it
    """

    channels: int
    held: bool = True

    @property
    def curve(self) -> int:
        """Where the channels' part of the state ends."""
        return 2 + 3 * (1 + self.channels)

    @property
    def n_state(self) -> int:
        return self.curve + 4 * (not self.held)

    @property
    def n_constants(self) -> int:
        return 3 + 4 * (1 + self.channels)

    @property
    def n_sample(self) -> int:
        return 1 + 2 * (1 + self.channels)


@cache
def build_layout_step(channels: int, held: bool) -> ca.Function:
    """For `SampleLoop`.

    Args:
        channels: how many are measured.
        held: the input is, from its sample to the next.
    """
    lay = LayoutStep(channels, held)
    state, const = ca.SX.sym("state", lay.n_state), ca.SX.sym("const", lay.n_constants)
    sample = ca.SX.sym("sample", lay.n_sample)
    # The input has no spike: not before this sample, nor with it, as its current may be sensed late.
    calm = ca.fmax(ca.fabs(state[2] - state[4]), ca.fabs(sample[1] - state[2])) <= const[6]
    kept, shown = [], []
    for k in range(1 + channels):
        limit, half_step, least, most = ca.vertsplit(const[3 + 4 * k : 7 + 4 * k])
        valid = ca.logic_and(sample[2 + 2 * k] > 0, ca.fabs(sample[1 + 2 * k]) <= limit)  # which a NaN is not
        value = ca.if_else(valid, sample[1 + 2 * k], 0.0)
        last, before, earlier = ca.vertsplit(state[2 + 3 * k : 5 + 3 * k])
        alike = ca.if_else(ca.fabs(value - last) <= half_step, before + 1.0, 1.0)
        # What is no measurement is passed over: the count that stood before it stands after it.
        kept += [ca.if_else(valid, new, old) for new, old in ((value, last), (alike, before), (last, earlier))]
        doubt = ca.if_else(alike >= least, ca.fmin(2.0 * alike * (alike - 1.0), _MOST_DOUBT), 1.0)
        value -= _ahead(value - last, before, half_step) * (alike <= 1.0)
        spike = ca.logic_and(ca.logic_and(_is_spike(earlier, last, value, most), calm), valid)
        shown.append((value, valid, doubt, alike, spike))
    value, valid, _, alike, _ = shown[0]
    known = ca.if_else(valid, value, state[1])
    extra = ca.if_else(valid, const[1] * ca.fmin(alike - 1.0, _MOST_ALIKE), const[2])
    measured = [
        x
        for value, valid, doubt, _, spike in shown[1:]
        for x in (value, ca.logic_and(valid, ca.logic_not(spike)), ca.if_else(spike, SPIKE, doubt))
    ]
    curve, runs = ([], []) if held else _runs(state, known, valid, sample[0] - state[0], lay)
    row = ca.vertcat(
        sample[0] - const[0],
        sample[0] - state[0],
        known,
        extra,
        *measured,
        _misread(state[2], state[4], known, const[6]),
        *runs,
    )
    return ca.Function("step", [state, const, sample], [ca.vertcat(sample[0], known, *kept, *curve), row])


def _runs(state: ca.SX, u: ca.SX, valid: ca.SX, h: ca.SX, lay: LayoutStep) -> tuple[list[ca.SX], list[ca.SX]]:
    """Of an input that is not held: what of the state is kept for the next sample; its mean over the step less that of
    the line, and its change across the step. Both are 0 in short steps and where one of the last three was unlike."""
    before, (earlier, earliest, last_h, other_h) = state[1], ca.vertsplit(state[lay.curve :])
    step_s = ca.if_else(valid, h, 0.0)  # what was no measurement is on no curve
    shortest = ca.fmin(step_s, ca.fmin(last_h, other_h))
    alike = ca.fmax(step_s, ca.fmax(last_h, other_h)) <= GAP_FACTOR * shortest
    counts = ca.logic_and(shortest > BENDS_S, alike)
    second = u - 2.0 * before + earlier
    third = u - 3.0 * before + 3.0 * earlier - earliest
    off = -second / 12.0 - third / 24.0
    return [before, earlier, step_s, last_h], [ca.if_else(counts, x, 0.0) for x in (off, u - before)]


def _misread(last: ca.SX, before: ca.SX, after: ca.SX, most: ca.SX) -> ca.SX:
    """What is to be added to the input that was held until now; 0 where it was no spike."""
    there, back = last - before, last - after
    far = ca.fmin(ca.fabs(there), ca.fabs(back)) > most
    lone = ca.logic_and(ca.logic_and(far, there * back > 0), before < NO_VALUE)
    return ca.if_else(lone, (before + after) / 2.0 - last, 0.0)


def _is_spike(before: ca.SX, last: ca.SX, value: ca.SX, most: ca.SX) -> ca.SX:
    """Whether a reading is far from both before it, which are close together: the one after a step is like one of them,
    so is the one that comes back, and where a signal runs they are as far apart."""
    near = ca.fmin(ca.fabs(value - last), ca.fabs(value - before))
    return ca.logic_and(near > ca.fmax(most, _APART * ca.fabs(last - before)), before < NO_VALUE)


def _ahead(moved: ca.SX, before: ca.SX, half_step: ca.SX) -> ca.SX:
    """By how much a count's middle is ahead of a shaft that has just come to it.

    Args:
        moved: by how much the count has changed; beyond one step it says nothing of where in the count the shaft is.
        before: samples on the count before.
    """
    from_middle = half_step * (1.0 - 1.0 / ca.fmax(before, 1.0))
    return ca.if_else(ca.fabs(moved) <= 3.0 * half_step, ca.sign(moved) * from_middle, 0.0)
