"""The measurement update of the filter's step: a sample's channels, one after another.

Covariance in Joseph's form with an arbitrary gain (Bucy & Joseph 1968; Bierman 1977, eq. II.6.8):

    P⁺ = P − k (P Hᵀ)ᵀ − (P Hᵀ) kᵀ + s k kᵀ,   s = H P Hᵀ + r

kept as its lower triangle, so that it is symmetric by construction. Because the form holds for any gain, a parameter
whose motion says nothing can be held by zeroing its row of the gain (Schmidt's "considered" parameter) and a suspected
outlier by enlarging r, both without P becoming a lie.

An innovation beyond `GATE` standard deviations is not thrown away but weighted down to the weight it would have at the
gate: a single wrong sample moves nothing much, a model that has gone wrong is never locked out of its data. The
variance that this takes is given half to the sensor and half to the state it shows: the sample may lie, but the motor
may also have been pushed by what is in no signal (a wrong voltage sample), and a state that then stays behind would
make every sample after it an outlier.
"""

from __future__ import annotations

import casadi as ca

from servo_daemon.kalman.expressions import natural
from servo_daemon.kalman.gaussian import to_coordinate
from servo_daemon.kalman.layout import CLIP, MEASURABLE, SPIKE, STATISTICS, EkfLayout

#: Standard deviations at which an innovation is weighted down: 1 in 1.7 million for a Gaussian (decision 9).
GATE = 5.0
#: Where the input is known this many times worse than usual (in variance), as after a missing sample, the innovations
#: are no sample of the usual noise (chosen; half and twice move no tracking figure).
UNUSUAL_INPUT = 30.0


def measurement_update(
    lay: EkfLayout, z: ca.SX, P: ca.SX, state: ca.SX, const: ca.SX, sample: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """One sample's channels.

    Args:
        z, P: mean (n_z,) and covariance (n_z, n_z) predicted for it.
        state: the filter's before it; see `EkfLayout`, as for `const` and `sample`.

    Returns:
        z, P and, as `EkfLayout` has them in the state and the output, information with statistics, and innovations.
    """
    n_x = lay.n_x
    rows = ca.vertcat(ca.SX.ones(n_x), const[lay.active])
    information, outputs, statistics = state[lay.information], [], []
    for k, channel in enumerate(lay.channels):
        y, valid, doubt = sample[4 + 3 * k], sample[5 + 3 * k], sample[6 + 3 * k]
        r = const[lay.r][k] * doubt
        shown, H = _shown(lay, channel)
        predicted, H_here = ca.Function("shown", shown, [H[0], H[1]])(z, sample[0])
        innovation = y - predicted
        s0 = H_here @ P @ H_here.T + r
        extra = valid * ca.fmax(innovation**2 / GATE**2 - s0, 0.0)
        own = lay.plant.state_names.index(channel)
        P[own, own] += extra / 2
        PHt, s = P @ H_here.T, s0 + extra
        gain = valid / s * rows * PHt
        # What this sample would tell of each parameter if it were free: held ones must be able to wake up.
        p_qq, seen = ca.diag(P)[n_x:], PHt[n_x:]
        reduction = seen**2 / s
        information = information + valid * reduction / (p_qq * (p_qq - reduction))
        z = z + gain * innovation
        P = P - gain @ PHt.T - PHt @ gain.T + s * (gain @ gain.T)
        gated = ca.logic_or(extra > 0, doubt >= SPIKE)
        if k == 0:  # a misread input is one, too
            gated = ca.logic_or(gated, valid * sample[lay.correction] != 0)
        outputs += [valid * innovation, ca.if_else(valid > 0, s0, 1.0), gated]
        counts = valid * (doubt <= 1.0) * (state[lay.held_variance] <= UNUSUAL_INPUT * const[0])
        statistics.append(_counted(state[lay.statistics], k, innovation, s0, counts, gated))
    bounds = [(to_coordinate(p, p.lower), to_coordinate(p, p.upper)) for p in lay.plant.parameters]
    q = [ca.fmax(ca.fmin(z[n_x + k], high), low) for k, (low, high) in enumerate(bounds)]
    return ca.vertcat(z[:n_x], *q), P, ca.vertcat(information, *statistics), ca.vertcat(*outputs)


def _counted(before: ca.SX, k: int, innovation: ca.SX, s0: ca.SX, counts: ca.SX, outlier: ca.SX) -> ca.SX:
    """Channel k's `STATISTICS` with one more sample, if it `counts`."""
    n = len(STATISTICS)
    count, nis, excess, lagged, last, gated, crossed = ca.vertsplit(before[k * n : (k + 1) * n])
    normalised = innovation / ca.sqrt(s0)
    return ca.vertcat(
        count + counts,
        nis + counts * normalised**2,
        excess + counts * s0 * (ca.fmin(normalised**2, CLIP**2) - 1.0),
        lagged + counts * normalised * last,
        ca.if_else(counts > 0, normalised, last),
        gated + outlier,
        crossed + counts * normalised * before[STATISTICS.index("last")],
    )


def _shown(lay: EkfLayout, channel: str) -> tuple[list[ca.SX], tuple[ca.SX, ca.SX]]:
    """What the channel's sensor shows and its derivative, as expressions in fresh symbols."""
    z, t = ca.SX.sym("z", lay.n_z), ca.SX.sym("t")
    value = lay.plant.sensed(z[: lay.n_x], natural(lay.plant, z[lay.n_x :]), t)[MEASURABLE.index(channel)]
    return [z, t], (value, ca.jacobian(value, z))
