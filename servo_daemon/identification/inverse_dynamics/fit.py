"""Inverse-dynamic identification (`fit --method idim`): the balances as regressions, solved once, without a simulation.

The method of Gautier & Khalil (*Modeling, Identification and Control of Robots*, 2002, ch. 12) with the filtering of
`filter.py`: no start values and no iteration, but the whole motion must be measured well enough to be
differentiated twice. With a torque (force) the shaft alone is identified; with voltage and current both balances; with
the current alone K must be fixed, or another torque (`Tg` of a known load), or only ratios to K are determined; with
the voltage alone R and K must be fixed, and the current is what they make of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from types import MappingProxyType

import numpy as np

from servo_daemon.errors import BadInputError, CaptureError
from servo_daemon.identification.inverse_dynamics.armature import ArmatureFit, Lag, fit_armature, made_current
from servo_daemon.identification.inverse_dynamics.estimate import Axis, Estimate
from servo_daemon.identification.inverse_dynamics.filter import Filter, FilterChoice, choose
from servo_daemon.identification.inverse_dynamics.integral import moves_of, rows_in_windows
from servo_daemon.identification.inverse_dynamics.result import Found, as_estimates, sorted_out
from servo_daemon.identification.inverse_dynamics.shaft import check_effects, has_dry_friction, kinematics, rows
from servo_daemon.identification.inverse_dynamics.signals import FEWEST, EvenStretch, even_stretch, pieces
from servo_daemon.identification.inverse_dynamics.solve import MakeRows, blurred, solve_shaft
from servo_daemon.numerics import sample_period
from servo_daemon.regression.linear_regression import ROBUST, autocorrelation
from servo_daemon.samples import F64, SampleBlock


@dataclass(frozen=True, slots=True)
class BalanceResidual:
    """What one balance leaves; shapes (w,), in N·m (N), A or V as `unit` says.

    Attributes:
        time_s: of the filtered rows; starts again with every capture.
        measured: the filtered effort.
        predicted: what the model makes of the motion.
    """

    unit: str
    time_s: F64
    measured: F64
    predicted: F64

    @property
    def residual(self) -> F64:
        return self.measured - self.predicted

    @property
    def relative_error(self) -> float:
        """|measured − predicted| / |measured|: the literature's "relative force error"."""
        return float(np.linalg.norm(self.residual) / max(float(np.linalg.norm(self.measured)), 1e-300))

    @property
    def autocorrelation(self) -> float:
        """Of neighbouring rows: near zero for a model that leaves noise only."""
        return autocorrelation(self.residual)


@dataclass(frozen=True, slots=True)
class InverseDynamics:
    """The result.

    Attributes:
        parameters: what the data determine, by name; "J/K" and the like where K is not known.
        undetermined: positive parameters that are not above 2 σ: the number says nothing.
        null_directions: combinations of coefficients that change nothing: none of theirs is in `parameters`.
        correlation_names, correlation: of the estimates' errors, shapes (n,) and (n, n).
        residuals: by balance: "shaft", "armature".
        filters: what was used, by balance.
        notes: sentences for the user.
    """

    parameters: Mapping[str, Estimate]
    undetermined: Mapping[str, Estimate]
    null_directions: tuple[Mapping[str, float], ...]
    correlation_names: tuple[str, ...]
    correlation: F64
    residuals: Mapping[str, BalanceResidual]
    filters: Mapping[str, Filter]
    notes: tuple[str, ...]


def identify_inverse_dynamics(
    blocks: Sequence[SampleBlock],
    effects: Sequence[str] = (),
    fixed: Mapping[str, float] | None = None,
    *,
    choice: FilterChoice | None = None,
    axis: Axis = "rotary",
) -> InverseDynamics:
    """Identify from one or more captures of the same motor with the same signals.

    Args:
        blocks: whole captures.
        effects: on top of the linear motor; see `idim_shaft.SUPPORTED`.
        fixed: parameters that are known, in SI units.
        choice: frequencies of the filter; None, or a field that is None: from the data.
        axis: only the units' names depend on it.

    Raises:
        ConfigError: an effect that is not linear in its parameters.
        BadInputError: signals are missing, or the captures are too short.
    """
    check_effects(effects)
    given = dict(fixed or {})
    channels = _check_signals(blocks, effects, given)
    period = float(np.median(np.concatenate([np.diff(b.time_s) for b in blocks])))
    whole = [piece for block in blocks for piece in pieces(block) if len(piece) >= FEWEST]
    moves = None
    if choice is None and has_dry_friction(effects):
        moves = moves_of(blocks, sum(map(len, whole)))
    choice = choice or FilterChoice()
    if not whole and moves is None:
        raise BadInputError(f"no {FEWEST} samples without a gap: nothing can be filtered and differentiated")
    notes: list[str] = []
    armature, filters = None, dict[str, Filter]()
    if {"voltage_V", "current_A"} <= channels and "torque_Nm" not in channels:
        armature, filters["armature"] = _armature(whole, period, choice, effects, given)
    if not channels & {"torque_Nm", "current_A"}:
        notes.append("no current: it is what R, L and K as given make of the voltage")
    problems: list[MakeRows] = []
    for L in _inductances(armature, given):
        make_effort = partial(_effort, armature=armature, given=given, L=L)
        if moves is not None:
            make_rows, filters["shaft"] = rows_in_windows(moves, make_effort, effects, 1.0 / period)
            problems.append(make_rows)
        else:
            problems.append(_filtered(whole, make_effort, period, effects, choice, filters))
    notes += [moves.note(sum(map(len, blocks)))] if moves is not None else _note_on_lost(whole, blocks)
    return _finish(problems, filters, given, axis, armature, "torque_Nm" in channels, notes)


def _filtered(
    whole: Sequence[SampleBlock],
    make_effort: Callable[[SampleBlock], F64],
    period: float,
    effects: Sequence[str],
    choice: FilterChoice,
    filters: dict[str, Filter],
) -> MakeRows:
    evened = [even_stretch(piece, make_effort(piece), period) for piece in whole]
    f = filters.setdefault("shaft", _shaft_filter(evened, choice))
    long = [s for s in evened if len(s.effort) >= f.shortest]
    return partial(rows, long, [kinematics(s, f) for s in long], f, effects)


def _note_on_lost(whole: Sequence[SampleBlock], blocks: Sequence[SampleBlock]) -> list[str]:
    n = sum(map(len, blocks))
    lost = n - sum(map(len, whole))
    if not lost:
        return []
    return [f"{lost} of {n} samples are not used: fewer than {FEWEST} in a row between gaps cannot be filtered"]


def _inductances(armature: ArmatureFit | None, given: Mapping[str, float]) -> tuple[float, ...]:
    """L by which the current went on between samples: 1 σ below and above, where nobody knows none and a large one."""
    if armature is None or "L" in given:
        return (given.get("L", 0.0),)
    if (L := armature.get("L", given)) is None:
        return (0.0, np.inf)
    k = armature.names.index("L")
    std = float(np.sqrt(armature.covariances[ROBUST, k, k]))
    return (max(L - std, 0.0), L + std)


def _effort(piece: SampleBlock, armature: ArmatureFit | None, given: Mapping[str, float], L: float) -> F64:
    """Torque or current at the samples, shape (n,), or, where it is known how it went on between them, its means over
    the intervals, shape (n − 1,)."""
    if piece.torque_Nm is not None:
        return piece.torque_Nm
    if piece.voltage_V is None:
        assert piece.current_A is not None
        return piece.current_A
    current = piece.current_A if piece.current_A is not None else made_current(piece, given)
    R, K = (given.get(n) if armature is None else armature.get(n, given) for n in ("R", "K"))
    if R is None or K is None:
        return np.asarray((current[1:] + current[:-1]) / 2)
    period = sample_period(piece.time_s)
    made = piece.current_A is None  # of speeds that are constant over an interval: nothing bends
    return Lag.of(R, L, period).mean_current(piece, current, 0.0 if made else K / R)


def _finish(
    problems: Sequence[MakeRows],
    filters: Mapping[str, Filter],
    given: Mapping[str, float],
    axis: Axis,
    armature: ArmatureFit | None,
    torque: bool,
    notes: list[str],
) -> InverseDynamics:
    shaft = reduce(blurred, (solve_shaft(make_rows, given, armature, torque) for make_rows in problems))
    notes += shaft.notes
    residuals = {"shaft": BalanceResidual(_effort_unit(torque, shaft.ratios, axis), *shaft.series)}
    if armature is not None:
        predicted = armature.measured - armature.fit.residual
        residuals["armature"] = BalanceResidual("V", armature.time_s, armature.measured, predicted)
    return _result(sorted_out(shaft, armature, axis), residuals, filters, notes)


def _note_on_lag(undetermined: Mapping[str, Estimate]) -> list[str]:
    if "L" not in undetermined:
        return []
    return ["L is not determined: R and J may be off by what the current does between samples; give L (--fix L=…)"]


def _result(
    found: Found, residuals: Mapping[str, BalanceResidual], filters: Mapping[str, Filter], notes: Sequence[str]
) -> InverseDynamics:
    good, bad = as_estimates(found)
    covariance = found.covariances[ROBUST]
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    return InverseDynamics(
        parameters=MappingProxyType(good),
        undetermined=MappingProxyType(bad),
        null_directions=found.null_directions,
        correlation_names=found.names,
        correlation=covariance / np.outer(spread, spread),
        residuals=MappingProxyType(dict(residuals)),
        filters=MappingProxyType(dict(filters)),
        notes=(*notes, *_note_on_lag(bad)),
    )


def _effort_unit(torque: bool, ratios: bool, axis: Axis) -> str:
    if not torque and ratios:
        return "A"
    return "N" if axis == "linear" else "N·m"


def _check_signals(blocks: Sequence[SampleBlock], effects: Sequence[str], given: Mapping[str, float]) -> set[str]:
    if not blocks:
        raise BadInputError("no capture")
    channels = set(blocks[0].channels)
    if any(set(b.channels) != channels for b in blocks):
        raise CaptureError("the captures carry different signals: identify them one by one")
    if not channels & {"position_rad", "velocity_rad_s"}:
        raise CaptureError("--method idim needs a position or a speed to differentiate: this capture has neither")
    if not channels & {"torque_Nm", "current_A"}:
        missing = [n for n in ("R", "K") if n not in given]
        if missing:
            raise BadInputError(
                f"with the voltage alone the torque follows from R and K: give {' and '.join(missing)} (--fix R=…,K=…)"
            )
    if "current_sensor_offset" in effects and not {"voltage_V", "current_A"} <= channels:
        raise BadInputError(
            "current_sensor_offset needs voltage and current: without a voltage it is the same as constant_load_torque"
        )
    return channels


def _shaft_filter(stretches: Sequence[EvenStretch], choice: FilterChoice) -> Filter:
    order = 1 if stretches[0].position is None else 2
    motions, efforts = [s.motion for s in stretches], [s.effort for s in stretches]
    f = choose(choice, stretches[0].rate_Hz, motions, efforts, order)
    if max(map(len, efforts)) < f.shortest:
        raise _too_short(f)
    return f


def _armature(
    whole: Sequence[SampleBlock],
    period_s: float,
    choice: FilterChoice,
    effects: Sequence[str],
    given: Mapping[str, float],
) -> tuple[ArmatureFit, Filter]:
    """With a filter of its own: at higher frequencies the encoder's noise, which reaches the voltage through the servo
    loop, would be taken for an inductance."""
    rate = 1.0 / period_s
    longest = max(whole, key=len)
    moves = longest.position_rad if longest.position_rad is not None else longest.velocity_rad_s
    assert moves is not None and longest.current_A is not None
    order = 2 if longest.position_rad is not None else 1
    f = choose(replace(choice, trim_samples=None), rate, [moves], [longest.current_A], order)
    long = [piece for piece in whole if len(piece) > f.shortest]
    if not long:
        raise _too_short(f)
    return fit_armature(long, f, given, "current_sensor_offset" in effects), f


def _too_short(f: Filter) -> BadInputError:
    return BadInputError(
        f"the capture is too short: a filter at {f.dynamics_Hz:.3g} Hz needs {f.shortest} samples without a gap"
    )
