"""Load-dependent friction: a gear or screw rubs in proportion to the torque it carries."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.columns.regressors import Regressors, itself
from servo_daemon.plant.columns.screening import Basis, Context, positive
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.samples import F64

MU = Parameter(
    "mu",
    r"\mu",
    "1",
    0.03,
    1e-06,
    0.95,
    "log",
    "share of the motor's torque that friction takes",
    "start value",
    scale=Scale(0.05),
)

#: No gear loses more; without a bound the torque itself would explain what is missing of it.
_MOST_MU = 0.6


def _terms(s: Signals) -> Terms:
    return Terms(dry_friction=s.p["mu"] * ca.fabs(s.torque))


def _screening(c: Context) -> Iterator[Basis]:
    if "K" not in c.motion.p:
        return

    def start(b: F64) -> dict[str, float] | None:
        return {"mu": b[0]} if positive(b[0]) and b[0] < _MOST_MU else None

    load = np.abs(c.motion.p["K"] * c.motion.i) * c.rest_friction
    yield Basis((c.torque("load sgn", load),), start, 1)


EFFECT = Effect(
    name="load_dependent_friction",
    cause="Gear teeth, a worm or a screw press together harder the more torque they carry, and rub in proportion.",
    equation=r"\mu\,|K i|\operatorname{sgn}\omega",
    parameters=(MU,),
    terms=_terms,
    screening=_screening,
    regressors=Regressors(shaft=(itself(MU, share=True),), signals=lambda c, _: [c.sliding * np.abs(c.effort)]),
    share_of={MU.name: ""},
    ladder=40,
    substeps=2,
)
