"""Encoder eccentricity: the shown angle runs ahead and behind once a turn."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from servo_daemon.parameters import MOTOR_NAMES, Parameter, Scale
from servo_daemon.plant.columns.regressors import NO_COLUMNS
from servo_daemon.plant.columns.screening import Basis, Context, Trace, phase
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.samples import F64

E_ENC = Parameter(
    "e_enc", "e", "rad", 0.01, 1e-09, 3.0, "log", "amplitude of the encoder's error", "start value", scale=Scale(0.01)
)
PHI_ENC = Parameter(
    "phi_enc", r"\varphi_e", "rad", 0.0, -6.5, 6.5, "identity", "its phase at angle zero", "start value"
)

#: rad; no encoder reads a disc that is further off centre. Without a bound an error of a radian would imitate gravity.
_MOST_ECCENTRIC = 0.3


def _terms(s: Signals) -> Terms:
    return Terms(sensed={"position_rad": s.p["e_enc"] * ca.sin(s.theta + s.p["phi_enc"])})


def _screening(c: Context) -> Iterator[Basis]:
    angle = c.motion.at_sample["position_rad"]

    def start(b: F64) -> dict[str, float] | None:
        size, phi = phase(b[0], b[1])
        return {"e_enc": size, "phi_enc": phi} if size < _MOST_ECCENTRIC else None

    shown = [{"position_rad": wave, "velocity_rad_s": rate * c.motion.at_sample["velocity_rad_s"]}
             for wave, rate in ((np.sin(angle), np.cos(angle)), (np.cos(angle), -np.sin(angle)))]  # fmt: skip
    columns = tuple(c.add(f"eccentric {k}", Trace(shown=s)) for k, s in enumerate(shown))
    yield Basis(columns, start, 2)


EFFECT = Effect(
    name="encoder_eccentricity",
    cause="The encoder's disc sits off the shaft's centre or wobbles: what it shows runs ahead and behind once a turn.",
    equation=r"\theta_{\mathrm{shown}} = \theta + e\sin(\theta + \varphi_e)",
    parameters=(E_ENC, PHI_ENC),
    terms=_terms,
    screening=_screening,
    regressors=NO_COLUMNS,
    phases={PHI_ENC.name: ""},
    kind="angle",
    # At a small amplitude the phase may be anything, and neither these nor the motor's parameters can be told apart.
    hides={PHI_ENC.name: (E_ENC.name, PHI_ENC.name, *MOTOR_NAMES)},
    ladder=160,
)
