"""Starts by least squares on the two balances, over windows of several lengths.

    v = R i + L di/dt + K ω + c          K i = J dω/dt + B ω + c'

Over short windows noise and the encoder's steps drown accelerations, over long ones the winding and the motion are
averaged away: which length suits a capture nobody knows, and a start costs one simulation to try. A balance has no
minima but one, whatever the scale of a channel, and the model's misfit moves its coefficients by as much as it is
large. Without a current the shaft's answer to the voltage remains, v = (R J/K) dω/dt + (K + R B/K) ω + c."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from servo_daemon.numerics import least_squares
from servo_daemon.samples import F64, SampleBlock

#: Samples in a window: a factor of four from one to the next, so that none is off by more than two.
_WINDOWS = (2, 8, 32)
#: Fewest windows that are a regression.
_FEWEST = 12


def window_starts(block: SampleBlock, guess: Mapping[str, float]) -> Iterator[tuple[int, dict[str, float]]]:
    """Per length of the windows (samples): the motor's parameters, natural units; one that came out negative as
    guessed.

    Args:
        block: with voltage and motion.
        guess: of R, L, K, J and B.
    """
    for length in _WINDOWS:
        if len(block) // length >= _FEWEST:
            found = _balances(block, length) if block.current_A is not None else _answer(block, length, guess)
            if found:
                yield length, {**guess, **{n: v for n, v in found.items() if np.isfinite(v) and v > 0.0}}


def _balances(block: SampleBlock, length: int) -> dict[str, float]:
    assert block.voltage_V is not None and block.current_A is not None
    (v, _), (i, slope), (w, acceleration) = (
        _smooth(block, x, length) for x in (block.voltage_V, block.current_A, _speed(block))
    )
    one = np.ones_like(v)
    armature = _solved([i, slope, w, one], v)
    if armature is None:
        return {}
    R, L, K = armature[:3].tolist()
    shaft = _solved([acceleration, w, one], K * i) if K > 0.0 else None
    J, B = (-1.0, -1.0) if shaft is None else shaft[:2].tolist()
    return {"R": R, "L": L, "K": K, "J": J, "B": B}


def _answer(block: SampleBlock, length: int, guess: Mapping[str, float]) -> dict[str, float]:
    """With R, and friction's share of the braking, as guessed: neither shows."""
    assert block.voltage_V is not None
    (v, _), (w, acceleration) = (_smooth(block, x, length) for x in (block.voltage_V, _speed(block)))
    found = _solved([acceleration, w, np.ones_like(v)], v)
    if found is None or found[0] <= 0.0 or found[1] <= 0.0:
        return {}
    share = guess["B"] * guess["R"] / guess["K"] ** 2
    K = float(found[1]) / (1.0 + share)
    return {"K": K, "B": share * K**2 / guess["R"], "J": float(found[0]) * K / guess["R"]}


def _speed(block: SampleBlock) -> F64:
    """rad/s, shape (n,), each until the next sample."""
    if block.position_rad is None:
        assert block.velocity_rad_s is not None
        return block.velocity_rad_s
    speed = np.diff(block.position_rad) / np.diff(block.time_s)
    return np.append(speed, speed[-1])


def _smooth(block: SampleBlock, values: F64, length: int) -> tuple[F64, F64]:
    """Means over three windows in a row, weighted 1 2 1, and the slope from the first to the last of them, shapes
    (k,)."""
    n = len(values) // length * length
    mean = values[:n].reshape(-1, length).mean(axis=1)
    time = block.time_s[:n].reshape(-1, length).mean(axis=1)
    return (mean[:-2] + 2.0 * mean[1:-1] + mean[2:]) / 4.0, (mean[2:] - mean[:-2]) / (time[2:] - time[:-2])


def _solved(columns: list[F64], y: F64) -> F64 | None:
    """Least squares with columns of any size; None where they do not tell one coefficient from another."""
    A = np.column_stack(columns)
    good = np.isfinite(A).all(axis=1) & np.isfinite(y)
    A, y = A[good], y[good]
    if len(A) < _FEWEST - 2:
        return None
    found, rank = least_squares(A, y)
    return found if rank == A.shape[1] else None
