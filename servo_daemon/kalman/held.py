"""The filter's step with parameters that are given: an ordinary Kalman filter of the plant's states.

The same expressions as `model`'s with nothing but zeros where the parameters' covariance is. So nothing is derived by
the parameters, there is no instrumental trajectory, and what follows from the parameters and the length of the step
alone is computed once for every length: a tenth of the time, the same numbers.
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.kalman.layout import EkfLayout
from servo_daemon.kalman.model import build_ekf_step
from servo_daemon.plant.build import PlantModel


@cache
def build_held_step(plant: PlantModel, channels: tuple[str, ...], mean_input: bool) -> tuple[EkfLayout, ca.Function]:
    """As a function for `SampleLoop`, paced by the sample's second element.

    state:     x | lower triangle of P's part of x by columns | held input | its variance
    constants: `EkfLayout`'s | the parameters' coordinates
    sample, output: `EkfLayout`'s

    Args:
        channels, mean_input: as `build_ekf_step` has them.
    """
    lay, step = build_ekf_step(plant, channels, mean_input)
    n_x, n_tri = lay.n_x, lay.n_x * (lay.n_x + 1) // 2
    own = ca.SX.sym("state", n_x + n_tri + 2)
    given, sample = ca.SX.sym("const", lay.n_constants + lay.n_q), ca.SX.sym("sample", lay.n_sample)
    const = ca.vertcat(given[: lay.n_constants])
    const[lay.walk] = const[lay.active] = 0.0
    state = ca.SX.zeros(lay.n_state)
    state[lay.x] = own[:n_x]
    for k, p in enumerate(plant.parameters):
        q = given[lay.n_constants + k]
        state[n_x + k] = ca.fmax(ca.fmin(q, to_coordinate(p, p.upper)), to_coordinate(p, p.lower))
    state[lay.held_input], state[lay.held_variance] = own[-2], own[-1]
    for k, at in enumerate(lay.state_covariance):
        state[at] = own[n_x + k]
    after, output = step(state, const, sample)
    parts = [after[lay.x], *[after[at] for at in lay.state_covariance], after[lay.held_input], after[lay.held_variance]]
    return lay, ca.Function("step", [own, given, sample], ca.cse([ca.vertcat(*parts), output]))
