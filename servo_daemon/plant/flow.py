"""The exact solution of the linear core over one sample, in closed form.

For x' = A x + b u with u held (ZOH), Z = A h and the φ-functions φ_0 = exp, φ_{k+1}(z) = (φ_k(z) − 1/k!)/z
(Hochbruck & Ostermann, *Exponential integrators*, Acta Numerica 2010, eq. 2.10–2.11):

    x(h) = φ_0(Z) x + h φ_1(Z) b u          ∫x = h φ_1(Z) x + h² φ_2(Z) b u

A 2 × 2 matrix function is α I + β Z (Cayley–Hamilton), its coefficients divided differences of φ_k on the spectrum.
Three branches keep every one of them accurate to rounding (about 1e-13) for any h·|A|, stiff or not:
a Taylor polynomial near zero, Newton's form on distinct real eigenvalues, and recurrences from exp otherwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import casadi as ca

_TAYLOR_TERMS = 14  # 1/16! = 5e-14 is what is cut off at spectral radius 1
_SMALL = 0.5  # m² + |x| below this: spectral radius below 1
_DISTINCT = 1e-3  # x > this · m²: eigenvalues differ by at least 6 % of their mean
_NEAR = 0.3  # |x| below this: series of cosh √x and sinh √x / √x
#: Over less of the winding's time constant than this a current within a step is a parabola: below it the exponential's
#: terms cancel.
_NEARLY_STRAIGHT = 0.05


class MatrixFunction(NamedTuple):
    """f(Z) = alpha I + beta Z."""

    alpha: ca.SX
    beta: ca.SX


def _phi2_taylor_matrix(m: ca.SX, d: ca.SX, terms: int = _TAYLOR_TERMS) -> MatrixFunction:
    """φ_2 by Horner's rule in the algebra of α I + β Z, where Z² = 2 m Z − d I."""
    alpha, beta = ca.SX(1.0 / math.factorial(terms + 2)), ca.SX(0)
    for k in range(terms - 1, -1, -1):
        alpha, beta = -d * beta + 1.0 / math.factorial(k + 2), alpha + 2 * m * beta
    return MatrixFunction(alpha, beta)


def phi_scalar(z: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """φ_0, φ_1, φ_2 of a scalar, accurate for any z ≤ 0 of any size, z = 0 included."""
    small = ca.fabs(z) < _SMALL
    safe = ca.if_else(small, -1.0, z)
    taylor = ca.SX(1.0 / math.factorial(_TAYLOR_TERMS + 2))
    for k in range(_TAYLOR_TERMS - 1, -1, -1):
        taylor = taylor * z + 1.0 / math.factorial(k + 2)
    phi1 = ca.if_else(small, 1 + z * taylor, ca.expm1(safe) / safe)
    phi2 = ca.if_else(small, taylor, (ca.expm1(safe) / safe - 1) / safe)
    return ca.exp(z), phi1, phi2


def _distinct(m: ca.SX, d: ca.SX, x: ca.SX) -> list[MatrixFunction]:
    """Newton's form on two real eigenvalues a (the faster) and b."""
    a = m - ca.sqrt(x)
    b = d / a  # the product of the roots: no cancellation however slow b is
    functions = []
    for f_a, f_b in zip(phi_scalar(a), phi_scalar(b), strict=True):
        beta = (f_a - f_b) / (a - b)
        functions.append(MatrixFunction(f_b - beta * b, beta))
    return functions


def _from_exponential(m: ca.SX, d: ca.SX, x: ca.SX) -> list[MatrixFunction]:
    """Complex or nearly equal eigenvalues of modulus ≥ about 0.7: d is then far from 0 and may divide."""
    p = ca.sqrt(ca.if_else(x < -_NEAR, -x, 1.0))
    cosh, sinhc = ca.SX(1.0 / math.factorial(16)), ca.SX(1.0 / math.factorial(17))
    for k in range(7, -1, -1):
        cosh, sinhc = cosh * x + 1.0 / math.factorial(2 * k), sinhc * x + 1.0 / math.factorial(2 * k + 1)
    C = ca.exp(m) * ca.if_else(x < -_NEAR, ca.cos(p), cosh)
    S = ca.exp(m) * ca.if_else(x < -_NEAR, ca.sin(p) / p, sinhc)
    exp = MatrixFunction(C - m * S, S)
    phi1_beta = (1 - exp.alpha) / d
    phi1 = MatrixFunction(exp.beta - 2 * m * phi1_beta, phi1_beta)
    phi2_beta = (1 - phi1.alpha) / d
    return [exp, phi1, MatrixFunction(phi1.beta - 2 * m * phi2_beta, phi2_beta)]


def _raise(f: MatrixFunction, constant: float, m: ca.SX, d: ca.SX) -> MatrixFunction:
    """constant · I + Z f(Z): φ_k from φ_{k+1}."""
    return MatrixFunction(constant - d * f.beta, f.alpha + 2 * m * f.beta)


def phi_matrix(Z: ca.SX) -> tuple[MatrixFunction, MatrixFunction, MatrixFunction]:
    """φ_0, φ_1, φ_2 of a 2 × 2 matrix Z whose eigenvalues have no positive real part.

    Args:
        Z: shape (2, 2), A·h, dimensionless.
    """
    m = (Z[0, 0] + Z[1, 1]) / 2
    d = Z[0, 0] * Z[1, 1] - Z[0, 1] * Z[1, 0]
    x = ((Z[0, 0] - Z[1, 1]) / 2) ** 2 + Z[0, 1] * Z[1, 0]  # m² − d without its cancellation
    small = m * m + ca.fabs(x) < _SMALL
    distinct = ca.logic_and(ca.logic_not(small), x > _DISTINCT * m * m)

    phi2 = _phi2_taylor_matrix(m, d)
    phi1 = _raise(phi2, 1.0, m, d)
    taylor = [_raise(phi1, 1.0, m, d), phi1, phi2]
    # A branch not taken is evaluated all the same: give it harmless arguments, or its NaN spoils the derivatives.
    real = _distinct(ca.if_else(distinct, m, -2.0), ca.if_else(distinct, d, 3.0), ca.if_else(distinct, x, 1.0))
    neither = ca.logic_not(ca.logic_or(small, distinct))
    other = _from_exponential(ca.if_else(neither, m, -1.0), ca.if_else(neither, d, 2.0), ca.if_else(neither, x, -1.0))

    def choose(k: int, part: int) -> ca.SX:
        return ca.if_else(small, taylor[k][part], ca.if_else(distinct, real[k][part], other[k][part]))

    exp, first, second = (MatrixFunction(choose(k, 0), choose(k, 1)) for k in range(3))
    return exp, first, second


def phi_series(Z: ca.SX, terms: int, doublings: int) -> tuple[MatrixFunction, MatrixFunction, MatrixFunction]:
    """φ_0, φ_1, φ_2 of a 2 × 2 matrix Z without a branch: `terms` of the series at Z/2^doublings, then doubled
    (Higham, *Functions of Matrices*, 2008, section 10.7.4). For code that runs where every instruction counts.

    Args:
        Z: shape (2, 2), A·h, dimensionless; its spectral radius is to be at most about 2^(doublings − 1).
    """
    Y = Z / 2**doublings
    m, d = (Y[0, 0] + Y[1, 1]) / 2, Y[0, 0] * Y[1, 1] - Y[0, 1] * Y[1, 0]

    def times(f: MatrixFunction, g: MatrixFunction) -> MatrixFunction:
        both = f.beta * g.beta
        return MatrixFunction(f.alpha * g.alpha - d * both, f.alpha * g.beta + f.beta * g.alpha + 2 * m * both)

    second = _phi2_taylor_matrix(m, d, terms)
    first = _raise(second, 1.0, m, d)
    exp = _raise(first, 1.0, m, d)
    for _ in range(doublings):
        square = times(first, first)
        second = MatrixFunction((square.alpha + 2 * second.alpha) / 4, (square.beta + 2 * second.beta) / 4)
        grown = times(exp, first)
        first = MatrixFunction((grown.alpha + first.alpha) / 2, (grown.beta + first.beta) / 2)
        exp = times(exp, exp)
    scale = 2.0**-doublings  # of β: Y is Z by that much
    return (
        MatrixFunction(exp.alpha, exp.beta * scale),
        MatrixFunction(first.alpha, first.beta * scale),
        MatrixFunction(second.alpha, second.beta * scale),
    )


def apply(f: MatrixFunction, Z: ca.SX, vector: ca.SX) -> ca.SX:
    """f(Z) · vector."""
    return f.alpha * vector + f.beta * (Z @ vector)


def mean_square(before: ca.SX, change: ca.SX, mean: ca.SX, z: ca.SX) -> ca.SX:
    """⟨i²⟩ over a step, A²: of i = a + b exp(z s) + d s, s from 0 to 1, between the currents at both ends, with the
    mean that the step's own balance L Δi = h (u − R ⟨i⟩) − K Δθ gives. The exponential is the winding's, the straight
    part what the speed makes meanwhile.

    Args:
        before, change, mean: current before the step, its change over it and its mean, A.
        z: −h R/L.
    """
    above = mean - before - change / 2  # a straight line
    slow = ca.fabs(z) < _NEARLY_STRAIGHT
    z = ca.if_else(slow, -1.0, z)
    _, phi1, phi2 = phi_scalar(z)
    _, phi1_twice, _ = phi_scalar(2 * z)
    b = above / (z * (phi2 - phi1 / 2))
    a, d = before - b, change - b * z * phi1
    curve = a**2 + b**2 * phi1_twice + d**2 / 3 + 2 * a * b * phi1 + a * d + 2 * b * d * (phi1 - phi2)
    c, middle = 6 * above, before + change / 2  # the parabola through the same
    parabola = middle**2 + change**2 / 12 + c * middle / 3 + c**2 / 30
    return ca.if_else(slow, parabola, curve)
