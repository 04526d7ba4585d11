"""Load-dependent friction: a gear or screw rubs in proportion to the torque it carries."""

from __future__ import annotations

import casadi as ca
import numpy as np

from servo_daemon.parameters import Parameter, Scale
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.plant.regressors import Regressors, itself

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


def _terms(s: Signals) -> Terms:
    return Terms(dry_friction=s.p["mu"] * ca.fabs(s.torque))


EFFECT = Effect(
    name="load_dependent_friction",
    cause="Gear teeth, a worm or a screw press together harder the more torque they carry, and rub in proportion.",
    equation=r"\mu\,|K i|\operatorname{sgn}\omega",
    parameters=(MU,),
    terms=_terms,
    regressors=Regressors(shaft=(itself(MU, share=True),), signals=lambda c, _: [c.sliding * np.abs(c.effort)]),
    share_of={MU.name: ""},
    ladder=40,
    substeps=2,
)
