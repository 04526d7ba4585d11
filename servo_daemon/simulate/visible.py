"""How strong an effect is on the simulated motor where nobody says."""

from __future__ import annotations

from collections.abc import Mapping

from servo_daemon.plant.effects.cogging_torque import HARMONICS

#: Values that show on the paper's motor (4 N·m and 13 A at 8 rad/s), where an effect's start value is meant for a fit.
VISIBLE: Mapping[str, float] = {
    "Tc": 0.3,
    "TL": 0.4,
    "Tg": 0.5,
    "phi_g": 0.3,
    "R_th": 2.0,
    "C_th": 15.0,
    "i0": 0.3,
    "Tc_neg": 0.45,
    "B_neg": 0.6,
    "Ts": 0.5,
    "ws": 0.4,
    "Tc_slope": 0.05,
    "mu": 0.06,
    "c2": 0.01,
    "dTL": 0.5,
    "t_TL": 5.0,
    "Tper": 0.3,
    "f_per": 7.0,
    **{f"Tcog{ending}": 0.3 / k for k, ending in enumerate(HARMONICS, start=1)},
    **{f"n_cog{ending}": 12.0 * k for k, ending in enumerate(HARMONICS, start=1)},
    "k_rip": 0.08,
    "n_rip": 10.0,
    "g_i": 1.05,
    "v0": 0.5,
    "e_enc": 0.02,
    "Vb": 1.0,
    "dR": 0.1,
    "t_R": 5.0,
    "I_sat": 60.0,
    "t_lag": 0.003,
    "t_d": 0.002,
    "t_f": 0.004,
    "k_s": 800.0,
    "c_s": 0.3,
    "J_l": 0.004,
    "gap": 0.03,
}
