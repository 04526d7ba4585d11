"""Initial states of short runs that suit them best, with the parameters given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.identification.short_runs.runs import Runs
from servo_daemon.samples import F64

#: Iterations of a descent, and by what share of the sum of squares one must lower it.
_ITERATIONS, _ENOUGH = 4, 1e-3
#: Tries of a step, with this much more damping each.
_TRIES, _HARDER, _FIRST_DAMPING, _LEAST_DAMPING = 3, 10.0, 1e-3, 1e-6
#: Places of the load that are tried, as shares of the gap and of the fastest rate, and how many of them descend.
_PLACES, _RATES, _DESCEND = np.linspace(-0.5, 0.5, 5), np.array([-1, -0.5, -0.25, -0.1, 0, 0.1, 0.25, 0.5, 1]), 2
#: Noise of a sensor to begin with, as a share of its signal.
_FINE = 1e-4
#: Curvature that counts as none.
_FLAT = 1e-12


@dataclass(frozen=True)
class Settled:
    """Runs from the states that suit them.

    Attributes:
        states: shape (k, nx).
        residuals: shape (k, n·c), over σ.
        squares: shape (k,).
    """

    states: F64
    residuals: F64
    squares: F64

    @classmethod
    def at(cls, runs: Runs, q: F64, states: F64, sigma: F64) -> Settled:
        """The runs with these initial states."""
        r = runs.residuals(q, states, sigma)
        return cls(states, r, _squares(r))

    def with_some(self, which: NDArray[np.bool_], others: Settled) -> Settled:
        """With these of the runs as the others have them."""
        states, residuals, squares = self.states.copy(), self.residuals.copy(), self.squares.copy()
        states[which], residuals[which], squares[which] = others.states, others.residuals, others.squares
        return Settled(states, residuals, squares)

    def or_better(self, other: Settled) -> Settled:
        """Of each run the better one of the two."""
        take = other.squares < self.squares
        return Settled(
            np.where(take[:, None], other.states, self.states),
            np.where(take[:, None], other.residuals, self.residuals),
            np.where(take, other.squares, self.squares),
        )


def descended(runs: Runs, q: F64, states: F64, sigma: F64, iterations: int = _ITERATIONS) -> Settled:
    """Each run's own Levenberg–Marquardt from these states, shape (k, nx)."""
    here = Settled.at(runs, q, states, sigma)
    damping, moved = np.full(len(states), _FIRST_DAMPING), np.ones(len(states), dtype=bool)
    J = np.empty((*here.residuals.shape, states.shape[1]))
    for _ in range(iterations):
        slopes = runs.only(moved).by_states(q, here.states[moved], sigma, here.residuals[moved])
        J[moved] = np.where(np.isfinite(slopes), slopes, 0.0)
        H, g = np.einsum("kni,knj->kij", J, J), np.einsum("kni,kn->ki", J, _finite(here.residuals))
        before, todo = here.squares, np.ones(len(states), dtype=bool)
        for _ in range(_TRIES):
            ahead = here.states + _step(H, g, damping)
            there = here.with_some(todo, Settled.at(runs.only(todo), q, ahead[todo], sigma))
            fell = todo & (there.squares < here.squares)
            damping = np.where(fell, np.maximum(damping / _HARDER, _LEAST_DAMPING), damping)
            here, todo = here.or_better(there), todo & ~fell
            damping = np.where(todo, damping * _HARDER, damping)
            if not todo.any():
                break
        moved = ~todo
        with np.errstate(invalid="ignore"):
            if float(np.nansum(before - here.squares)) < _ENOUGH * float(np.sum(here.squares)):
                break
    return here


def _step(H: F64, g: F64, damping: F64) -> F64:
    size = np.einsum("kii->ki", H) + _FLAT
    damped = H + (damping[:, None] * size)[:, :, None] * np.eye(H.shape[1])
    damped += _FLAT * np.eye(H.shape[1])
    return np.asarray(np.linalg.solve(damped, g[:, :, None])[:, :, 0])


def searched(runs: Runs, q: F64, states: F64, sigma: F64) -> Settled:
    """The best of descents from places of the load all over the gap and rates up to the fastest, and from these states.

    Of each place the motor's own states are found linearly, and what they leave says which places are worth a descent.
    """
    here = Settled.at(runs, q, states, sigma)
    Q, R = np.linalg.qr(runs.by_states(q, states, sigma, here.residuals, runs.motor_states))
    tried = [states]
    left = [_squares(_without(Q, here.residuals))]
    twist, rate = runs.load_states
    for place in (_PLACES * runs.gap_rad(q)).tolist():
        for speed in (_RATES * runs.fastest_rad_s).tolist():
            x = states.copy()
            x[:, twist], x[:, rate] = place, speed
            r = runs.residuals(q, x, sigma)
            x[:, runs.motor_states] += np.linalg.solve(
                R + _FLAT * np.eye(R.shape[1]), np.einsum("kni,kn->ki", Q, _finite(r))[:, :, None]
            )[:, :, 0]
            tried.append(x)
            left.append(_squares(_without(Q, r)))
    best, order = descended(runs, q, states, sigma), np.argsort(np.stack(left), axis=0)
    every = np.arange(len(states))
    for k in range(_DESCEND):
        best = best.or_better(descended(runs, q, np.stack(tried)[order[k], every], sigma))
    return best


def _finite(values: F64) -> F64:
    return np.where(np.isfinite(values), values, 0.0)


def _without(Q: F64, r: F64) -> F64:
    """What is left of each run's residuals beside what its columns explain; infinite stays infinite."""
    return np.asarray(r - np.einsum("kni,ki->kn", Q, np.einsum("kni,kn->ki", Q, _finite(r))))


def _squares(residuals: F64) -> F64:
    """Sums of squares, infinite where a run left the range of numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        out = np.einsum("kn,kn->k", residuals, residuals)
    return np.where(np.isfinite(out), out, np.inf)


def eliminated(J: F64, columns: F64, residuals: F64) -> tuple[F64, F64]:
    """Derivatives by parameters, shape (k, m, p), and residuals, shape (k, m), less what initial states explain.

    Args:
        J: derivatives by the states, shape (k, m, nx).
    """
    Q, _ = np.linalg.qr(J)
    return np.asarray(columns - np.einsum("kni,kij->knj", Q, np.einsum("kni,knj->kij", Q, columns))), _without(
        Q, residuals
    )


def first_sigma(runs: Runs) -> F64:
    """σ of each channel to begin with, shape (c,)."""
    return np.asarray(_FINE * runs.scale[[runs.plant.state_names.index(c) for c in runs.channels]])


def floor(runs: Runs, settled: Settled, sigma: F64) -> F64:
    """σ of each channel as the best quarter of the runs leaves it, shape (c,)."""
    r = settled.residuals.reshape(runs.measured.shape)
    counts = np.maximum(runs.valid.sum(axis=1), 1)
    rms = np.sqrt(np.where(np.isfinite(r), r * r, 0.0).sum(axis=1) / counts)
    return np.asarray(sigma * np.maximum(np.quantile(rms, 0.25, axis=0), 1e-6))
