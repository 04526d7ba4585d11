"""Encoder eccentricity: the shown angle runs ahead and behind once a turn."""

from __future__ import annotations

import casadi as ca

from servo_daemon.parameters import LINEAR, Parameter, Scale
from servo_daemon.plant.effects.base import Effect, Signals, Terms
from servo_daemon.plant.regressors import NO_COLUMNS

E_ENC = Parameter(
    "e_enc", "e", "rad", 0.01, 1e-09, 3.0, "log", "amplitude of the encoder's error", "start value", scale=Scale(0.01)
)
PHI_ENC = Parameter(
    "phi_enc", r"\varphi_e", "rad", 0.0, -6.5, 6.5, "identity", "its phase at angle zero", "start value"
)


def _terms(s: Signals) -> Terms:
    return Terms(sensed={"position_rad": s.p["e_enc"] * ca.sin(s.theta + s.p["phi_enc"])})


EFFECT = Effect(
    name="encoder_eccentricity",
    cause="The encoder's disc sits off the shaft's centre or wobbles: what it shows runs ahead and behind once a turn.",
    equation=r"\theta_{\mathrm{shown}} = \theta + e\sin(\theta + \varphi_e)",
    parameters=(
        E_ENC,
        PHI_ENC,
    ),
    terms=_terms,
    regressors=NO_COLUMNS,
    phases={PHI_ENC.name: ""},
    kind="angle",
    # A small wave in everything.
    hides={PHI_ENC.name: (E_ENC.name, PHI_ENC.name, *(p.name for p in LINEAR))},
    ladder=160,
)
