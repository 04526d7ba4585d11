"""`models`: every effect of the contract in the data and in the daemon's model, on all motors, 20 s each.

A datasheet of the motor that is wrong by 40 %; the effect clear (20 % of the working torque or voltage), its values
given 15 % off, as a diagnosis leaves them at worst (`near`), or not given at all (`unknown`). Orders, frequencies, gaps
and instants are given: a running filter holds them. Beside it the same data with the linear model, which is what the
daemon had before somebody named the effect.

Known: R, K, J and B are `tracking` at the end. Wrong: one of these or of the effect's parameters is `tracking` at the
end, more than 4 std and more than 5 % off (of the linear model not R where it steps or warms up: that R is followed).
A gain of the current sensor that is given 15 % off makes R and J wrong by as much: nothing shows it.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from servo_daemon.plant.effects import parameter_table
from servo_daemon.samples import F64
from tests.recovery.generator import MOTORS, Recording, Scenario, generate
from tests.recovery.generator.effects import LISTED
from tests.recovery.generator.sizes import typical
from tests.recovery.tracking.follow import Track, deviations, nominal_of, sampled, tracked

#: What a running filter holds.
HELD = ("n_cog", "n_rip", "f_per", "gap", "t_R", "t_TL")
NEAR = 1.15
STDS, OFF = 4.0, 0.05
_CORE = ("R", "K", "J", "B")


@dataclass(frozen=True, slots=True, eq=False)
class ModelRun:
    """A recording with an effect, the true values of the effect's parameters, what was published, and the names of the
    parameters that have one true value."""

    recording: Recording
    truth: dict[str, float]
    track: Track
    judged: tuple[str, ...]

    def deviations(self) -> tuple[tuple[str, ...], F64, F64]:
        """Names of the parameters with a true value, (value − truth)/std while `tracking` (else 0), and the relative
        error; shapes (m, names)."""
        n, track = len(self.recording.truth.time_s), self.track
        known = {**self.recording.truth.parameters, **{name: np.full(n, v) for name, v in self.truth.items()}}
        names = tuple(name for name in track.names if name in known and name in self.judged)
        stds, error = deviations(track, known, self.recording.truth.time_s, names)
        true = sampled(known, self.recording.truth.time_s, names, track.time_s)
        return names, stds, error / np.maximum(np.abs(true), 1e-12)

    def worst(self) -> dict[str, float]:
        """Largest |error| / std of each parameter while it is tracking; 0 if it never is."""
        names, stds, _ = self.deviations()
        return dict(zip(names, np.abs(stds).max(axis=0).tolist(), strict=True))

    @property
    def known(self) -> bool:
        """R, K, J and B are, at the end."""
        return bool(self.track.tracking[-1, [self.track.names.index(n) for n in _CORE]].all())

    @property
    def wrong(self) -> bool:
        """See the module."""
        _, stds, error = self.deviations()
        return bool(((np.abs(stds[-1]) > STDS) & (np.abs(error[-1]) > OFF)).any())


def run_model(
    effect: str,
    motor: str,
    motion: str = "multisine",
    near: float | None = None,
    *,
    modelled: bool = True,
    seconds: float = 20.0,
    seed: int = 1,
) -> ModelRun:
    """One run.

    Args:
        near: given values of the effect's parameters over the true ones; None: only what is held is given.
        modelled: the effect is in the daemon's model.
    """
    effects = typical(effect, MOTORS[motor], 0.2, seconds=seconds)
    recording = generate(MOTORS[motor], Scenario(motion, seconds=seconds, seed=seed, effects=effects))
    values = {n: v for parameters in effects.values() for n, v in parameters.items()}
    truth = {n: float(v) for n, v in values.items() if not isinstance(v, str)}
    given = {n: v for n, v in truth.items() if n in HELD}
    given |= {n: parameter_table()[n].read(v) for n, v in values.items() if isinstance(v, str)}
    if near is not None:
        given |= {n: v + 0.15 if n.startswith("phi") else near * v for n, v in truth.items() if n not in HELD}
    track = tracked(recording, nominal_of(MOTORS[motor]) | given, tuple(effects) if modelled else ())
    changes = not modelled and effect in ("resistance_step", "winding_heating")
    return ModelRun(recording, truth, track, tuple(n for n in track.names if not (changes and n == "R")))


def _row(effect: str, motion: str) -> tuple[str, list[tuple[bool, bool, bool]]]:
    """Known, explained, wrong of all motors, for the linear model, for the effect unknown and near."""
    runs = [
        run_model(effect, motor, motion, near, modelled=modelled)
        for modelled, near in ((False, None), (True, None), (True, NEAR))
        for motor in MOTORS
    ]
    return effect, [(r.known, bool(r.track.white[-1]), r.wrong) for r in runs]


def report_models(motion: str = "multisine") -> None:
    """Prints a table, one row an effect, and the sums."""
    kinds = ("linear model", "effect unknown", "effect near")
    print(
        f"\neach effect in the data, {len(MOTORS)} motors, {motion}, 20 s: how many of them end with R, K, J, B known /"
    )
    print("with innovations that are white / with something wrong")
    print(f"{'':28}" + "".join(f"{kind:>18}" for kind in kinds))
    total = np.zeros((len(kinds), 3), dtype=int)
    with ProcessPoolExecutor(2) as pool:
        for effect, flags in pool.map(partial(_row, motion=motion), LISTED):
            sums = np.array(flags).reshape(len(kinds), len(MOTORS), 3).sum(axis=1)
            total += sums
            print(f"{effect:28}" + "".join(f"{'{} / {} / {}'.format(*row):>18}" for row in sums), flush=True)
    print(f"{'of ' + str(len(LISTED) * len(MOTORS)):28}" + "".join(f"{'{} / {} / {}'.format(*r):>18}" for r in total))
