"""What the smoother makes of a supposed cause: the unmodelled torque and voltage that it would show.

The smoother is linear in the measurements, with gains that do not depend on them. A supposed torque, voltage or sensor
error is therefore carried through the same passes and compares with the series on equal terms: smoothed as they are,
shared out between torque and voltage as they are, with the same ends and gaps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.missing.smoother import BATCH, Augmented, response_backward, response_forward
from servo_daemon.plant.at_once import on_all_cores
from servo_daemon.plant.columns.screening import Trace
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.samples import F64

#: Samples that go through a pass at once: what they need stays in the processor's cache (chosen; not tried).
_AT_ONCE = 512


def smoothed(missing: Missing, traces: Sequence[Trace]) -> dict[str, F64]:
    """Per series of `missing` what the traces would show in it, shape (n, m)."""
    a, n = missing.augmented, len(missing.time_s)
    n_d = len(a.disturbances)
    out = np.empty((n, -(-len(traces) // BATCH) * BATCH, n_d))
    passes = response_forward(a), response_backward(a)

    def batch(first: int) -> None:
        given, at = _given(missing, traces[first : first + BATCH]), 0
        for stretch in missing.stretches:
            end = at + len(stretch.passed)
            shown = _answer(a, passes, stretch.passed, given[at:end])
            out[at:end, first : first + BATCH] = shown.reshape(-1, BATCH, n_d)
            at = end

    on_all_cores(batch, range(0, out.shape[1], BATCH))
    return {name: out[:, : len(traces), k] for k, name in enumerate(a.disturbances)}


def _given(missing: Missing, traces: Sequence[Trace]) -> F64:
    """A batch of traces as `response_forward` takes them, shape (n, BATCH · (2 + c))."""
    channels = missing.augmented.channels
    given = np.zeros((len(missing.time_s), BATCH, 2 + len(channels)))
    for k, trace in enumerate(traces):
        if trace.torque is not None:
            given[:, k, 0] = trace.torque
        if trace.voltage is not None:
            given[:, k, 1] = trace.voltage
        for name, values in trace.shown.items():
            if name in channels:
                given[:, k, 2 + channels.index(name)] = values
    return given.reshape(len(given), -1)


def _answer(a: Augmented, passes: tuple[SampleLoop, SampleLoop], passed: F64, given: F64) -> F64:
    """A batch through both passes, shape (n, BATCH · n_d)."""
    n, (forward, backward) = len(passed), passes
    ahead, out = np.empty((n, BATCH * (a.n_z + len(a.channels)))), np.empty((n, BATCH * len(a.disturbances)))
    parts = [slice(begin, begin + _AT_ONCE) for begin in range(0, n, _AT_ONCE)]
    state, none = np.zeros(BATCH * (a.n_x + a.n_z)), np.zeros(1)
    for part in parts:
        ahead[part] = forward.run(state, none, np.hstack([passed[part], given[part]]))
    state = np.zeros(BATCH * a.n_z)
    for part in reversed(parts):
        rows = np.hstack([passed[part][::-1], ahead[part][::-1]])
        out[part] = backward.run(state, none, rows)[::-1]
    return out
