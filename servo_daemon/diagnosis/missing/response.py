"""What the smoother makes of a supposed cause: the unmodelled torque and voltage that it would show.

The smoother is linear in the measurements, with gains that do not depend on them. A supposed torque, voltage or sensor
error is therefore carried through the same passes and compares with the series on equal terms: smoothed as they are,
shared out between torque and voltage as they are, with the same ends and gaps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servo_daemon.diagnosis.missing.missing import Missing
from servo_daemon.diagnosis.missing.smoother import BATCH, response_backward, response_forward
from servo_daemon.plant.at_once import on_all_cores
from servo_daemon.plant.columns.screening import Trace
from servo_daemon.samples import F64


def smoothed(missing: Missing, traces: Sequence[Trace]) -> dict[str, F64]:
    """Per series of `missing` what the traces would show in it, shape (n, m)."""
    a, n = missing.augmented, len(missing.time_s)
    c, n_d = len(a.channels), len(a.disturbances)
    inputs = np.zeros((n, -(-len(traces) // BATCH) * BATCH, 2 + c))
    for k, trace in enumerate(traces):
        if trace.torque is not None:
            inputs[:, k, 0] = trace.torque
        if trace.voltage is not None:
            inputs[:, k, 1] = trace.voltage
        for name, values in trace.shown.items():
            if name in a.channels:
                inputs[:, k, 2 + a.channels.index(name)] = values
    out = np.empty((n, inputs.shape[1], n_d))
    forward, backward = response_forward(a), response_backward(a)

    def batch(first: int) -> None:
        at = 0
        for stretch in missing.stretches:
            end = at + len(stretch.passed)
            given = inputs[at:end, first : first + BATCH].reshape(end - at, -1)
            ahead = forward.run(np.zeros(BATCH * (a.n_x + a.n_z)), np.zeros(1), np.hstack([stretch.passed, given]))
            rows = np.hstack([stretch.passed, ahead])[::-1]
            back = backward.run(np.zeros(BATCH * a.n_z), np.zeros(1), np.ascontiguousarray(rows))
            out[at:end, first : first + BATCH] = back[::-1].reshape(end - at, BATCH, n_d)
            at = end

    on_all_cores(batch, range(0, inputs.shape[1], BATCH))
    return {name: out[:, : len(traces), k] for k, name in enumerate(a.disturbances)}
