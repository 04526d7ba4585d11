"""The causes that can be hidden in a capture: which parameters each has, and their checks.

`LISTED` are the effects of the library under its names; `UNLISTED` are real causes that the
library does not hold. What is ours to say where the contract leaves it open:

- Load torques count positive against positive motion: J dω/dt = … − Tg sin(θ + phi_g), likewise cogging, TL, Tper.
- `backlash` and `shaft_compliance`: J stays the motor's side, J_l comes on top; encoder, friction and every load torque
  are on the motor's side; `gap` is the whole free angle; teeth press and never pull: the damper acts in contact only.
- `winding_heating`: the loss that heats is that of the hot resistance.
- `measurement_delay`: the channel ("current_A" or "position_rad") shows sample k what was t_d before.
- Sensors show `g_i·i + i0` and `v + v0`.
- `magnetic_saturation` has a limit of its own: where the back-EMF falls faster with the current than R i rises,
  2 K |ω i| / I_sat² > R (1 + (i/I_sat)²)², the current runs away. No motor is used there: keep I_sat well above.
- `position_dependent_friction` is for motions of bounded travel ("steps", "pick_and_place").
"""

from __future__ import annotations

import math
from collections.abc import Mapping

EffectValues = Mapping[str, float | str]

LISTED: Mapping[str, tuple[str, ...]] = {
    "coulomb_friction": ("Tc",),
    "asymmetric_friction": ("Tc", "Tc_neg", "B_neg"),
    "stribeck_friction": ("Tc", "Ts", "ws"),
    "position_dependent_friction": ("Tc_slope", "Tc_curve"),
    "load_dependent_friction": ("mu",),
    "quadratic_drag": ("c2",),
    "gravity_load": ("Tg", "phi_g"),
    "cogging_torque": ("Tcog", "n_cog", "phi_cog"),
    "torque_ripple": ("k_rip", "n_rip", "phi_rip"),
    "constant_load_torque": ("TL",),
    "load_torque_step": ("dTL", "t_TL"),
    "periodic_disturbance": ("Tper", "f_per", "phi_per"),
    "brush_voltage_drop": ("Vb",),
    "magnetic_saturation": ("I_sat",),
    "winding_heating": ("R_th", "C_th"),
    "resistance_step": ("dR", "t_R"),
    "backlash": ("gap", "k_s", "c_s", "J_l"),
    "shaft_compliance": ("k_s", "c_s", "J_l"),
    "encoder_eccentricity": ("e_enc", "phi_enc"),
    "current_sensor_offset": ("i0",),
    "current_sensor_gain": ("g_i",),
    "voltage_sensor_offset": ("v0",),
    "measurement_delay": ("t_d", "channel"),
    "drive_lag": ("t_lag",),
}

#: Further harmonics of the cogging torque may be given.
_OPTIONAL = {"cogging_torque": tuple(f"{name}_{k}" for k in (2, 3) for name in ("Tcog", "n_cog", "phi_cog"))}

UNLISTED: Mapping[str, tuple[str, ...]] = {
    # a mass that turns along within a sector of width_sector about theta_sector, edges edge_sector wide
    "sector_mass": ("J_sector", "theta_sector", "width_sector", "edge_sector"),
    # Dahl: a spring that yields at T_hyst and remembers, theta_hyst to its yield point
    "hysteresis_spring": ("T_hyst", "theta_hyst"),
    # eddy currents in solid iron: c_root ω / sqrt(|ω| + w_root)
    "root_drag": ("c_root", "w_root"),
    # eddy-current brake: its greatest torque T_eddy at the speed w_eddy
    "eddy_brake": ("T_eddy", "w_eddy"),
    # dry friction T_spot more where the shaft passes theta_spot, width_spot (1 σ) wide, once a turn
    "sticky_spot": ("T_spot", "theta_spot", "width_spot"),
    # a slipping coupling: the torque falls by the share `depth` for duration_s, rate_hz times a second at random
    "torque_dropouts": ("depth", "rate_hz", "duration_s"),
    # iron saturates: L / (1 + (i/I_L)²)
    "inductance_saturation": ("I_L",),
}

#: Of the contract as well, but only to be seen in motions that command exactly zero: no matrix draws it.
AT_ZERO: Mapping[str, tuple[str, ...]] = {"freewheel_drive": ()}

ALL: Mapping[str, tuple[str, ...]] = {**LISTED, **UNLISTED}
_KNOWN = {**ALL, **AT_ZERO}
_DRY = {"coulomb_friction", "asymmetric_friction", "stribeck_friction", "load_dependent_friction"}
_CHANNELS = {"current_A": 1.0, "position_rad": 2.0}
#: Not the C code's business: the sensors' own, the input table's, and drawn at random.
_OUTSIDE = {"i0", "g_i", "v0", "TL", "depth", "rate_hz", "duration_s"}


def check_effects(effects: Mapping[str, EffectValues]) -> None:
    """Names, parameters and combinations make sense.

    Raises:
        ValueError: they do not; says which.
    """
    for name, values in effects.items():
        if name not in _KNOWN:
            raise ValueError(f"no effect {name!r}; there are {', '.join(_KNOWN)}")
        wanted, optional = set(_KNOWN[name]), set(_OPTIONAL.get(name, ()))
        if not wanted <= set(values) <= wanted | optional:
            raise ValueError(f"{name} has the parameters {sorted(wanted)}, not {sorted(values)}")
        bad = [key for key, value in values.items() if key != "channel" and not math.isfinite(float(value))]
        if bad:
            raise ValueError(f"{name}: not a finite number: {', '.join(bad)}")
    if "position_dependent_friction" in effects and not _DRY & set(effects):
        raise ValueError("position_dependent_friction varies a dry friction along the travel: name one")
    if {"backlash", "shaft_compliance"} <= set(effects):
        raise ValueError("backlash holds the spring of shaft_compliance: name one of them")


def setup_values(effects: Mapping[str, EffectValues]) -> dict[str, float]:
    """The effects as fields of the C code's Setup.

    Raises:
        ValueError: two effects give different values to a parameter they share, or one is impossible.
    """
    merged: dict[str, float | str] = {}
    for name, values in effects.items():
        for key, value in values.items():
            if merged.setdefault(key, value) != value:
                raise ValueError(f"{name}: {key} = {value} contradicts {merged[key]} of another effect")
    channel = str(merged.pop("channel", ""))
    fields = {key: float(value) for key, value in merged.items() if key not in _OUTSIDE}
    _check_signs(fields)
    fields.setdefault("Ts", fields.get("Tc", 0.0))
    fields.setdefault("Tc_neg", fields.get("Tc", 0.0))
    fields["asymmetric"] = float("asymmetric_friction" in effects)
    fields["freewheel"] = float("freewheel_drive" in effects)
    if fields.get("t_d", 0.0) > 0:
        if channel not in _CHANNELS:
            raise ValueError(f"measurement_delay: channel {channel!r} is none of {', '.join(_CHANNELS)}")
        fields["delayed_channel"] = _CHANNELS[channel]
    return fields


def _check_signs(fields: Mapping[str, float]) -> None:
    signed = {"Tc_slope", "Tc_curve", "Tg", "TL", "dTL", "dR", "Tper", "k_rip", "e_enc", "T_hyst", "mu"}
    for key, value in fields.items():
        free = key in signed or key.startswith(("phi", "Tcog", "theta_spot", "theta_sector"))
        if not free and value < 0:
            raise ValueError(f"{key} = {value} must not be negative")
    for key in ("ws", "I_sat", "R_th", "C_th", "J_l", "k_s", "w_root", "w_eddy", "width_spot", "edge_sector", "I_L"):
        if fields.get(key, 1.0) <= 0:
            raise ValueError(f"{key} = {fields[key]} must be positive")
    if fields.get("theta_hyst", 1.0) <= 0 or fields.get("mu", 0.0) >= 1:
        raise ValueError("theta_hyst must be positive, and mu below 1 (the motor would lock itself)")
