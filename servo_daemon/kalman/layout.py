"""Where everything is in the flat vectors that the compiled filter carries."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servo_daemon.plant.build import PlantModel

#: Sums over the samples since they were last taken, kept beside the state so that nothing walks over them again: how
#: many samples; Σ ν²/s; Σ (ν² clipped at `CLIP` σ − s); Σ of products of neighbours' ν/√s; the last ν/√s; how many were
#: gated; Σ of ν/√s times the first channel's one sample earlier. A standing encoder repeats itself: its samples are no
#: sample of any noise and count in the number of gated ones only; so do samples whose input was in doubt.
STATISTICS = ("count", "nis", "excess", "lagged", "last", "gated", "crossed")
#: Innovations beyond this many standard deviations do not teach the noise level (a Gaussian is beyond four once in
#: 16,000 times).
CLIP = 4.0

#: Marks a reading that is a spike of one sample: it is no measurement, and is counted as an outlier.
SPIKE = 1e9

#: Channels the filter can take, in the order in which it takes them.
MEASURABLE = ("current_A", "velocity_rad_s", "position_rad")


@dataclass(frozen=True)
class EkfLayout:
    """Where everything is in the flat vectors that the compiled loop carries.

    state:     x | q | lower triangle of P by columns | held input | its variance | information gained per parameter |
               `STATISTICS` per channel | instrumental trajectory | its age (s)
    constants: var_input | torque_psd | walk per parameter (1/s) | active per parameter | r per channel | time constant
               of the instrumental trajectory
    sample:    t | h | input | extra variance of the input | (y, valid, doubt) per channel; doubt multiplies r, and is
               `SPIKE` where that made a reading not valid | correction of the input before, which is then as uncertain
               as that is large | of an input that is not held: its mean over the step less that of the line, and its
               change across the step
    output:    (innovation, its variance, gated) per channel
    """

    plant: PlantModel
    channels: tuple[str, ...]

    @cached_property
    def n_x(self) -> int:
        return len(self.plant.states)

    @cached_property
    def n_q(self) -> int:
        return len(self.plant.parameters)

    @cached_property
    def n_z(self) -> int:
        return self.n_x + self.n_q

    @cached_property
    def n_tri(self) -> int:
        return self.n_z * (self.n_z + 1) // 2

    @cached_property
    def n_state(self) -> int:
        return self.n_z + self.n_tri + 2 + self.n_q + len(STATISTICS) * len(self.channels) + self.n_x + 1

    @cached_property
    def n_constants(self) -> int:
        return 2 + 2 * self.n_q + len(self.channels) + 1

    @cached_property
    def n_sample(self) -> int:
        return self.correction + 1 + 2 * (self.plant.drive != "voltage")

    @cached_property
    def correction(self) -> int:
        return 4 + 3 * len(self.channels)

    @cached_property
    def n_output(self) -> int:
        return 3 * len(self.channels)

    @cached_property
    def z(self) -> slice:
        return slice(0, self.n_z)

    @cached_property
    def x(self) -> slice:
        return slice(0, self.n_x)

    @cached_property
    def q(self) -> slice:
        return slice(self.n_x, self.n_z)

    @cached_property
    def tri(self) -> slice:
        return slice(self.n_z, self.n_z + self.n_tri)

    @cached_property
    def triangle(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Row and column of each element of P that is kept: its lower triangle by columns, as the step packs it."""
        columns, rows = np.triu_indices(self.n_z)
        return rows, columns

    @cached_property
    def state_covariance(self) -> tuple[int, ...]:
        """The elements of P's part of x, its lower triangle by columns."""
        rows, _ = self.triangle
        return tuple((self.tri.start + np.flatnonzero(rows < self.n_x)).tolist())

    @cached_property
    def held_input(self) -> int:
        return self.n_z + self.n_tri

    @cached_property
    def held_variance(self) -> int:
        return self.held_input + 1

    @cached_property
    def information(self) -> slice:
        return slice(self.held_variance + 1, self.held_variance + 1 + self.n_q)

    @cached_property
    def statistics(self) -> slice:
        """All channels' sums, one channel after the other."""
        return slice(self.information.stop, self.n_state - self.n_x - 1)

    @cached_property
    def trajectory(self) -> slice:
        """The plant's states as the model alone has them; see the module."""
        return slice(self.n_state - self.n_x - 1, self.n_state - 1)

    @cached_property
    def walk(self) -> slice:
        return slice(2, 2 + self.n_q)

    @cached_property
    def active(self) -> slice:
        return slice(self.walk.stop, self.walk.stop + self.n_q)

    @cached_property
    def r(self) -> slice:
        return slice(self.active.stop, self.n_constants - 1)
