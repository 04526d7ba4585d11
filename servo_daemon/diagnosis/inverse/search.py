"""The search in the shaft's balance: which torques the measured motion needs beyond inertia and viscous friction.

For a drive whose current (or torque) is measured and whose controller holds it where it would not stay by itself, a
rotor on the slopes between its detents, a free run says nothing: whatever is not known of its state grows many-fold
within a tenth of a second, and the model that follows best is a flywheel that no current moves. The balance runs
nowhere. The same division into parts holds as for free runs, and the same thresholds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from servo_daemon.diagnosis.inverse.fit import OFFSET, OWN, Explained, Start, Torque, own_torques
from servo_daemon.diagnosis.inverse.rows import BalanceRows
from servo_daemon.diagnosis.screening.derived import derived
from servo_daemon.diagnosis.screening.screen import has_no_formula
from servo_daemon.diagnosis.search.evidence import LEAST_OWN, LEAST_SHARE, LEAST_TOGETHER, convinces, ties_with
from servo_daemon.diagnosis.trial.compare import Advantage, bootstrapped
from servo_daemon.diagnosis.trial.split import CHOICE, HELD_OUT, TRAIN
from servo_daemon.numerics import least_squares
from servo_daemon.plant.columns.scans import HARMONICS
from servo_daemon.plant.columns.screening import Context, phase
from servo_daemon.plant.contribution import contribution
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.plant.effects.cogging_torque import HARMONICS as COGGING
from servo_daemon.samples import F64

#: As many harmonics of the turn as it takes.
_WAVES = "cogging_torque"
#: Effects that are linear in coefficients with a standard deviation, beside those that are so in their own parameters.
#: The others are rivals only: where one of them does better, nothing is named.
NAMED = (_WAVES, "gravity_load", "load_dependent_friction", "position_dependent_friction")
#: Of causes that do as well the one that every machine has.
_USUAL = "coulomb_friction"
#: Log of the squared error that a further harmonic must take, and the radians of one that an instant may pass: about a
#: quarter of its period, half of what sampling allows (the worth chosen, not tried).
_HARMONIC_WORTH, _RESOLVED = 0.15, 1.5
#: At most so many effects are taken: friction, a weight and cogging are what the drives of the field data have.
_MOST_EFFECTS = 3


@dataclass(frozen=True)
class Tried:
    """One supposed torque in one round: the balance with it, and what it gains."""

    torque: Torque
    explained: Explained
    against: Advantage
    beside: tuple[str, ...]


@dataclass(frozen=True)
class Found:
    """The torques that the search in the balance has named.

    Attributes:
        base, explained: without and with the torques.
        equivalent: by name of a torque, names that did as well in its place.
        tried: all that was fitted, by round, best first.
    """

    base: Explained
    explained: Explained
    equivalent: Mapping[str, tuple[str, ...]]
    tried: tuple[tuple[Tried, ...], ...]


def search_balance(rows: BalanceRows) -> Found | None:
    """Name what the balance lacks; None: nothing takes enough of it, or something does that has no name here."""
    base = current = Explained(rows, ())
    parts = {TRAIN, CHOICE} | ({HELD_OUT} & set(rows.part.tolist()))
    if min(np.count_nonzero(rows.at(p)) for p in parts) <= len(OWN):
        return None
    rounds: list[tuple[Tried, ...]] = []
    equivalent: dict[str, tuple[str, ...]] = {}
    while len(current.torques) < _MOST_EFFECTS:
        tried = sorted(_tried(current), key=lambda t: -t.against.gain)
        rounds.append(tuple(tried))
        if not tried or not _takes_enough(current, tried[0]):
            break
        best, alike = _simplest(tried)
        if not _may_be_named(best.torque.name):
            return None
        equivalent[best.torque.name] = tuple(dict.fromkeys(t.torque.name for t in alike))
        current = best.explained
    left, before = (e.scored(CHOICE).nrmse ** 2 for e in (current, base))
    if not current.torques or left > (1.0 - LEAST_TOGETHER) * before:
        return None
    return Found(base, current, equivalent, tuple(rounds))


def _simplest(tried: Sequence[Tried]) -> tuple[Tried, list[Tried]]:
    """The best, or what resampling cannot tell from it and is simpler; and the others that it cannot be told from."""
    first = tried[0].explained.scored(CHOICE)
    alike = [tried[0], *(t for t in tried[1:] if ties_with(t.explained.scored(CHOICE), first))]
    best = min(alike, key=lambda t: (t.torque.parameters, t.torque.name != _USUAL))
    return best, [t for t in alike if t is not best]


def _takes_enough(current: Explained, best: Tried) -> bool:
    before, after = current.scored(CHOICE).nrmse, best.explained.scored(CHOICE).nrmse
    return convinces(best.against) and after**2 <= (1.0 - LEAST_OWN) * before**2 and before - after > LEAST_SHARE


def _tried(current: Explained) -> Iterator[Tried]:
    present = {t.name for t in current.torques}
    best: dict[str, Tried] = {}
    for torque in _torques(current):
        explained = Explained(current.rows, (*current.torques, torque))
        if torque.name in present or explained.parameters_of(torque) is None:
            continue
        tried = Tried(torque, explained, _advantage(current, explained, torque), tuple(sorted(present)))
        if torque.name not in best or tried.against.gain > best[torque.name].against.gain:
            best[torque.name] = tried
    yield from best.values()


def _advantage(simple: Explained, rich: Explained, added: Torque) -> Advantage:
    here = rich.rows.at(TRAIN)
    n = max(rich.independent * float(here.sum()), 2.0)
    squares = [max(float(e.error[here] @ e.error[here]), 1e-300) for e in (simple, rich)]
    delta_bic = added.parameters * float(np.log(n)) - n * float(np.log(squares[0] / squares[1]))
    return Advantage(*bootstrapped(simple.scored(CHOICE), rich.scored(CHOICE)), delta_bic)


def _torques(current: Explained) -> Iterator[Torque]:
    """All that could be: the formulas of the screening, over the measured motion."""
    rows, m = current.rows, current.rows.motion
    direction = np.where(m.rest, 0.0, m.direction)
    left = rows.factor * m.u - np.column_stack(own_torques(rows)) @ current.coefficients[: len(OWN)]
    context = Context(m, {"torque": np.asarray(left)}, direction, ())
    for name, effect in effects_by_name().items():
        if name in (OFFSET, _WAVES) or effect.further or not _is_torque(name):
            continue
        family = effect.screening or derived(name)
        for basis in family(context):
            traces = [context.traces[key].torque for key in basis.columns]
            columns = np.column_stack([rows.filtered(t) for t in traces if t is not None])
            yield Torque(name, (name,), columns, _plain(basis.start), basis.parameters)
    cogging = _cogging(current)
    if cogging is not None:
        yield cogging


def _is_torque(name: str) -> bool:
    """Whether an effect is a torque along the motion, and nothing beside it."""
    added = contribution(name)
    return added.is_along_motion and [n for n in added.adds if added.touches(n)] == ["torque"]


def _may_be_named(name: str) -> bool:
    """Whether its coefficients have a standard deviation: see `NAMED`."""
    added = contribution(name)
    by_terms = has_no_formula(name) and _is_torque(name)
    return name in NAMED or (by_terms and added.linear == added.effect.parameters)


def _plain(start: Callable[[F64], Mapping[str, float | str] | None]) -> Start:
    def values(b: F64) -> Mapping[str, float] | None:
        found = start(b)
        return None if found is None else {n: float(v) for n, v in found.items() if not isinstance(v, str)}

    return values


def _cogging(current: Explained) -> Torque | None:
    """As many harmonics of the turn as pay for themselves, the largest first."""
    rows = current.rows
    theta, omega = rows.motion.theta, rows.motion.omega
    passed = float(np.percentile(np.abs(omega), 95.0)) / (rows.filter.rate_Hz * rows.instants)
    most = int(min(HARMONICS, _RESOLVED / max(passed, 1e-12)))
    least = max(2, int(np.ceil(2 * np.pi / max(float(np.ptp(theta)), 1e-9))))
    waves = {
        n: np.column_stack([rows.filtered(np.sin(n * theta)), rows.filtered(np.cos(n * theta))])
        for n in range(least, most + 1)
    }
    chosen: list[int] = []
    before = current
    while waves.keys() - chosen and len(chosen) < len(COGGING):
        n = _strongest(before, {k: w for k, w in waves.items() if k not in chosen})
        after = Explained(rows, (*current.torques, _harmonics([*chosen, n], waves)))
        errors = [max(e.scored(CHOICE).nrmse, 1e-12) for e in (before, after)]
        if 2 * np.log(errors[0] / errors[1]) < _HARMONIC_WORTH:
            break
        chosen, before = [*chosen, n], after
    return _harmonics(chosen, waves) if chosen else None


def _strongest(before: Explained, waves: Mapping[int, F64]) -> int:
    """The harmonic that takes most of what a balance leaves, beside its columns."""
    here = before.rows.at(TRAIN)
    own, _ = np.linalg.qr(before.table[here])

    def beside(x: F64) -> F64:
        return np.asarray(x - own @ (own.T @ x))

    y = beside(before.rows.torque[here])
    taken: dict[int, float] = {}
    for n, wave in waves.items():
        X = beside(wave[here])
        taken[n] = float(y @ X @ least_squares(X, y)[0])
    return max(taken, key=lambda n: taken[n])


def _harmonics(orders: Sequence[int], waves: Mapping[int, F64]) -> Torque:
    endings = COGGING[: len(orders)]

    def start(b: F64) -> Mapping[str, float]:
        out: dict[str, float] = {}
        for k, (n, ending) in enumerate(zip(orders, endings, strict=True)):
            size, angle = phase(b[2 * k], b[2 * k + 1])
            out |= {f"Tcog{ending}": size, f"n_cog{ending}": float(n), f"phi_cog{ending}": angle}
        return out

    columns = np.column_stack([waves[n] for n in orders])
    return Torque(_WAVES, tuple(f"{_WAVES}{e}" for e in endings), columns, start, 3 * len(orders))
