"""Symbolic forms of what the filter's flat vectors hold: parameters in their units, a covariance by its triangle."""

from __future__ import annotations

import casadi as ca

from servo_daemon.plant.build import PlantModel


def natural(plant: PlantModel, q: ca.SX) -> ca.SX:
    """Parameters in their units from what the filter estimates."""
    parts = [ca.exp(q[k]) if p.transform == "log" else q[k] for k, p in enumerate(plant.parameters)]
    return ca.vertcat(*parts)


def pack(P: ca.SX) -> ca.SX:
    """Lower triangle, column by column."""
    n = P.size1()
    return ca.vertcat(*[P[row, column] for column in range(n) for row in range(column, n)])


def unpack(tri: ca.SX, n: int) -> ca.SX:
    """The symmetric matrix of a lower triangle."""
    P, k = ca.SX.zeros(n, n), 0
    for column in range(n):
        for row in range(column, n):
            P[row, column] = P[column, row] = tri[k]
            k += 1
    return P
