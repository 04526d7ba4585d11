"""The shaft's balance as a regression: which columns the model has, and what its coefficients mean.

κ u − Σ (what is known) = J dω/dt + B ω + Σ (effects)         κ = K for a current u, 1 for a torque
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servo_daemon.errors import ConfigError
from servo_daemon.identification.inverse_dynamics.filter import Filter, noise_density, rests
from servo_daemon.identification.inverse_dynamics.signals import EvenStretch
from servo_daemon.plant import effects as library
from servo_daemon.samples import F64

#: Effects whose torque is linear in what is to be found.
SUPPORTED = (
    "coulomb_friction",
    "asymmetric_friction",
    "constant_load_torque",
    "gravity_load",
    "current_sensor_offset",
)
#: A shaft rests below so many standard deviations of the filtered speed, or this part of its rms.
_REST_SIGMA, _REST_SHARE = 4.0, 1e-3


@dataclass(frozen=True, slots=True)
class Kinematics:
    """Position (None where only the speed is measured), speed and acceleration, filtered; shapes (n,)."""

    position: F64 | None
    speed: F64
    acceleration: F64


def kinematics(s: EvenStretch, f: Filter) -> Kinematics:
    """By the filter: forward-backward low-pass, then central differences."""
    smooth = f.smooth(s.motion)
    speed = smooth if s.position is None else f.derivative(smooth)
    return Kinematics(None if s.position is None else smooth, speed, f.derivative(speed))


def speed_noise(s: EvenStretch, f: Filter) -> float:
    """1 σ of the filtered speed from the sensor's noise: ∫ S (2πf)² df up to the cut-off."""
    density = noise_density(s.motion, f.rate_Hz)
    if s.position is None:
        return float(np.sqrt(density * f.cutoff_Hz))
    return float(np.sqrt(density * (2 * np.pi) ** 2 * f.cutoff_Hz**3 / 3))


def check_effects(effects: Sequence[str]) -> None:
    """Raises ConfigError: an effect that is not linear in its parameters, or two that no model has together."""
    for name in effects:
        if name not in SUPPORTED:
            raise ConfigError(
                f"--method idim: {name} is not linear in its parameters; it takes {', '.join(SUPPORTED)} "
                "(output-error takes every effect)"
            )
    library.check_effects(effects)


def has_dry_friction(effects: Sequence[str]) -> bool:
    return not set(effects).isdisjoint(library.dry_frictions())


def shaft_columns(effects: Sequence[str], m: Kinematics, phi: float | None, Tg: float | None) -> dict[str, F64]:
    """Torque per unit of each parameter, shapes (n,).

    Args:
        phi: gravity's phase where it is known or guessed; None: gravity is the pair "Tg sin", "Tg cos".
        Tg: its amplitude where it is given: then "phi_g" is the change of the phase from `phi`, and "gravity" what is
            known.
    """
    columns = {"J": m.acceleration, "B": m.speed}
    names = {p.name for e in effects for p in library.effects_by_name()[e].parameters}
    forward, backward = (m.speed > 0).astype(float), (m.speed < 0).astype(float)
    if "Tc" in names:
        columns["Tc"] = forward - backward
    if "Tc_neg" in names:
        columns |= {"B": m.speed * forward, "B_neg": m.speed * backward, "Tc": forward, "Tc_neg": -backward}
    if "TL" in names:
        columns["TL"] = np.ones_like(m.speed)
    if "Tg" in names:
        columns |= _gravity(m, phi, Tg)
    return columns


def _gravity(m: Kinematics, phi: float | None, Tg: float | None) -> dict[str, F64]:
    if m.position is None:
        raise ConfigError("gravity_load needs a position: this capture has only a speed")
    if phi is None:
        return {"Tg sin": np.sin(m.position), "Tg cos": np.cos(m.position)}
    if Tg is None:
        return {"Tg": np.sin(m.position + phi)}
    return {"gravity": Tg * np.sin(m.position + phi), "phi_g": Tg * np.cos(m.position + phi)}


def over_intervals(columns: Mapping[str, F64], m: Kinematics, rate_Hz: float) -> dict[str, F64]:
    """The same columns as means from each sample to the next, shapes (n − 1,): exact for J and B, whose integrals are
    differences of speed and position, by the trapezoidal rule for the rest."""
    out = {name: (c[1:] + c[:-1]) / 2 for name, c in columns.items()}
    out["J"] = np.diff(m.speed) * rate_Hz
    if m.position is not None:
        speed = np.diff(m.position) * rate_Hz
        forward = (m.speed > 0).astype(float)
        share = (forward[1:] + forward[:-1]) / 2 if "B_neg" in columns else 1.0
        out["B"] = speed * share
        if "B_neg" in columns:
            out["B_neg"] = speed - out["B"]
    return out


def rows(
    stretches: Sequence[EvenStretch],
    motions: Sequence[Kinematics],
    f: Filter,
    effects: Sequence[str],
    gravity: tuple[float | None, float | None],
) -> tuple[list[str], F64, F64]:
    """Filtered rows of all stretches.

    Args:
        gravity: (phi, Tg) as in `shaft_columns`.

    Returns:
        names of the columns, length m; the columns, shape (w, m); time, shape (w,). The effort (current or torque) is
        the last column but one, "effort"; the last is "one".
    """
    parts, times = [], []
    names: list[str] = []
    for s, m in zip(stretches, motions, strict=True):
        columns = shaft_columns(effects, m, *gravity)
        if s.by_intervals:
            columns = over_intervals(columns, m, f.rate_Hz)
        columns |= {"effort": s.effort, "one": np.ones_like(s.effort)}
        names = list(columns)
        low = f.decimate(np.column_stack(list(columns.values())))
        keep = f.pick(_slides(s, m, f)[: len(s.effort)]) if has_dry_friction(effects) else np.ones(len(low), np.bool_)
        parts.append(low[keep])
        times.append(f.pick(s.time_s[: len(s.effort)])[keep])
    return names, np.concatenate(parts), np.concatenate(times)


def _slides(s: EvenStretch, m: Kinematics, f: Filter) -> NDArray[np.bool_]:
    """Samples, shape (n,), into which the low-pass of the decimation brings nothing from a rest."""
    threshold = max(_REST_SIGMA * speed_noise(s, f), _REST_SHARE * float(np.sqrt(np.mean(m.speed**2))))
    still = rests(m.speed, threshold, max(3, f.decimation))
    return np.asarray(np.convolve(still, np.ones(2 * f.decimation + 1), mode="same") < 0.5)
