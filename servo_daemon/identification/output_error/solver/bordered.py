"""Solving normal equations whose matrix has the shape of an arrow: parameters border the initial states.

A free run's initial state acts on that run alone, so of the unknowns beyond the parameters only small blocks on the
diagonal are filled. Eliminating these first (Schur complement: Golub & Van Loan, *Matrix Computations*, 4th ed. 2013,
sec. 3.2; Björck, *Numerical Methods for Least Squares Problems*, 1996, sec. 6.3) takes a time that grows with the
number of runs, not with its cube.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servo_daemon.samples import F64


def solve_bordered(H: F64, g: F64, free: NDArray[np.bool_], added: F64, parameters: int, states: int) -> F64:
    """(H + diag(added)) x = g over the free unknowns; 0 for the others.

    Args:
        H: shape (n, n), symmetric: `parameters` unknowns first, then blocks of `states` not coupled to each other.
        g, free, added: shapes (n,).
    """
    n, q = len(g), parameters
    blocks = (n - q) // max(states, 1)
    A = H[:q, :q] + np.diag(added[:q])
    every = np.arange(blocks)
    D = H[q:, q:].reshape(blocks, states, blocks, states)[every, :, every, :]
    D = D + added[q:].reshape(blocks, states, 1) * np.eye(states)
    E = H[q:, :q].reshape(blocks, states, q)
    b = np.where(free, g, 0.0)
    A, D, E = _held(A, free[:q], D, free[q:].reshape(blocks, states), E)
    right = np.concatenate([E, b[q:].reshape(blocks, states, 1)], axis=2)
    eliminated = np.linalg.solve(D, right)
    inner, own = eliminated[:, :, :q], eliminated[:, :, q]
    p = np.linalg.solve(A - np.einsum("bsi,bsj->ij", E, inner), b[:q] - np.einsum("bsi,bs->i", E, own))
    return np.concatenate([p, (own - inner @ p).ravel()])


def _held(A: F64, free: NDArray[np.bool_], D: F64, free_states: NDArray[np.bool_], E: F64) -> tuple[F64, F64, F64]:
    """What is not free has 1 on its diagonal and is coupled to nothing."""
    A = np.where(np.outer(free, free), A, np.diag(np.ones(len(free))))
    both = free_states[:, :, None] & free_states[:, None, :]
    D = np.where(both, D, np.eye(D.shape[1]))
    return A, D, np.where(free_states[:, :, None] & free, E, 0.0)
