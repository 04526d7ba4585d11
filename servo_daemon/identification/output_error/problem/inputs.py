"""What drives a simulation from one sample to the next."""

from __future__ import annotations

import numpy as np

from servo_daemon.conditioning.layout import INPUT
from servo_daemon.conditioning.layout_step import BENDS_S
from servo_daemon.identification.output_error.problem.rollout import INPUT as INPUT_COLUMN
from servo_daemon.identification.output_error.problem.rollout import STEP, TIME
from servo_daemon.plant.core import Drive
from servo_daemon.samples import F64, GAP_FACTOR, SampleBlock

#: Where the mean of a signal that runs straight between two samples lies.
STRAIGHT = 0.5


def input_rows(block: SampleBlock, drive: Drive, share: float = STRAIGHT) -> F64:
    """Shape (n, 3): time, step, input. A voltage is held from its sample on (the capture contract); a measured current
    or torque is a sample of a continuous signal, whose mean over the step lies at `share` of the way between them, and
    off that line by how it bends in a long step. A current that is a mean over the interval that ends at its sample is
    that mean."""
    mean = drive == "current" and block.current_mean
    if mean:
        share = 1.0
    time = block.time_s - block.time_s[0]
    rows = np.empty((len(time), 3))
    rows[:, TIME] = time
    rows[:-1, STEP] = np.diff(time)
    rows[-1, STEP] = np.median(rows[:-1, STEP])
    u: F64 = getattr(block, INPUT[drive])
    rows[:, INPUT_COLUMN] = u
    if drive != "voltage":
        rows[:-1, INPUT_COLUMN] = (1.0 - share) * u[:-1] + share * u[1:]
        if not mean and rows[-1, STEP] > BENDS_S:
            rows[:-1, INPUT_COLUMN] += _off_the_line(u, time)
    return rows


def _off_the_line(u: F64, time_s: F64) -> F64:
    """Shape (n − 1,): mean of a signal between two samples less that of the line between them (Euler–Maclaurin, second
    term with differences); 0 beside gaps and at the ends."""
    h = np.diff(time_s)
    out = -h / 12.0 * np.diff(np.gradient(u, time_s))
    alike = h < GAP_FACTOR * np.median(h)
    alike[1:-1] &= alike[:-2] & alike[2:]
    alike[[0, -1]] = False
    return np.where(alike, out, 0.0)
