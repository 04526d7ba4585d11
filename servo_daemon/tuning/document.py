"""A `Tuning` as the JSON document that `tune --json` prints and `GET /drives/{d}/tuning` answers with."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from servo_daemon.tuning import laws
from servo_daemon.tuning.advice import Advice
from servo_daemon.tuning.assess import smaller_gain_margin_dB
from servo_daemon.tuning.knowledge import NEEDED, UNITS, CascadeGains
from servo_daemon.tuning.laws import Gains
from servo_daemon.tuning.margins import Margins
from servo_daemon.tuning.report import InUse, Tuning
from servo_daemon.tuning.response import Response
from servo_daemon.tuning.search import Design
from servo_daemon.tuning.worst import Worst

Document = dict[str, Any]

#: Integrals must not run on while the voltage is at its limit.
_ANTI_WINDUP = (
    "while the voltage is limited: I_k = I_{k-1} + T (e_k + (v_limited - v_k) / k_p) with the last cycle's v; "
    "the position's sum S (or z) stands still"
)


def document(tuning: Tuning) -> Document:
    """JSON-ready: plain types, no NaN, no infinity. `answer` is there only where it is all that is known."""
    setup = tuning.setup
    told = tuple(n for n in NEEDED if n not in tuning.motor.open)
    return {
        "rate_hz": setup.rate_hz,
        "rate_source": setup.rate_source,
        "delay_samples": setup.delay_samples,
        "voltage_V": setup.voltage_V,
        "model": list(tuning.motor.effects),
        "asked": asdict(tuning.ask),
        "parameters": {
            name: {
                "value": None if name in tuning.motor.open else known.value,
                "std": known.std,
                "unit": UNITS[name],
                "source": known.source,
                "reason": known.why,
            }
            for name, known in ((n, tuning.motor.parameters[n]) for n in NEEDED)
        },
        **({"answer": [asdict(c) for c in tuning.motor.answer]} if tuning.motor.answer else {}),
        "region": tuning.region,
        "not_in_region": list(tuning.not_covered),
        "limits": asdict(setup.limits),
        "speed_filter": laws.SPEED_FILTER,
        "anti_windup": _ANTI_WINDUP,
        "designs": {d.family.key: _design(d, advice, told) for d, advice in tuning.designs},
        "in_use": None if tuning.in_use is None else _in_use(tuning.in_use, told),
    }


def _design(d: Design, advice: Advice, told: tuple[str, ...]) -> Document:
    return {
        "title": d.family.title,
        **_gains(d.gains),
        "capped": d.capped,
        "reason": d.reason,
        "margins": _margins(d.margins),
        "worst": None if d.worst is None else _worst(d.worst, told),
        "response": _response(d.response, d.gains),
        **_advice(advice),
    }


def _in_use(u: InUse, told: tuple[str, ...]) -> Document:
    return {
        "title": "the gains in use ([drive.controller])",
        **_gains(u.gains),
        "margins": _margins(u.margins),
        "nominal": None if u.nominal is None else _margins(u.nominal),
        "worst": None if u.worst is None else _worst(u.worst, told),
        "response": None if u.response is None else _response(u.response, u.gains),
        "weak": bool(u.weak),
        "warnings": [w.text for w in u.weak],
        **_advice(u.advice),
    }


def config_keys(gains: CascadeGains) -> dict[str, float]:
    """The gains under the names that `[drive.controller]` has for them; what is zero is left out."""
    keys: dict[str, float] = {}
    if gains.position_kp_1_s is not None:
        keys["position_kp_1_s"] = gains.position_kp_1_s
        if gains.position_ki_1_s2:
            keys["position_ki_1_s2"] = gains.position_ki_1_s2
        if gains.position_kd:
            keys["position_kd"] = gains.position_kd
    keys |= {"speed_kp_V_s_rad": gains.speed_kp_V_s_rad, "speed_ki_V_rad": gains.speed_ki_V_rad}
    keys["speed_setpoint_weight"] = gains.setpoint_weight
    if gains.filter_hz is not None:
        keys["speed_filter_hz"] = gains.filter_hz
    return keys


def _gains(gains: Gains) -> Document:
    if isinstance(gains, CascadeGains):
        law = laws.SPEED_LAW if gains.position_kp_1_s is None else laws.POSITION_LAW
        return {"law": law, "gains": config_keys(gains), "parallel_pid": _parallel(gains)}
    own = asdict(gains) | {"previous_V_V": list(gains.previous_V_V), "speed_filter_hz": gains.filter_hz}
    del own["filter_hz"]
    return {"law": laws.STATE_LAW, "gains": own, "parallel_pid": None}


def _parallel(g: CascadeGains) -> Document | None:
    """P around PI as one PID: v = P' θ* − P θ + I ∫(θ* − θ) dt − D ω̂ with P' = `P_on_setpoint_V_rad`."""
    if g.position_kp_1_s is None or g.position_ki_1_s2 or g.position_kd:
        return None
    return {
        "P_V_rad": g.setpoint_weight * g.speed_kp_V_s_rad * g.position_kp_1_s + g.speed_ki_V_rad,
        "I_V_rad_s": g.speed_ki_V_rad * g.position_kp_1_s,
        "D_V_s_rad": g.speed_kp_V_s_rad,
        "P_on_setpoint_V_rad": g.setpoint_weight * g.speed_kp_V_s_rad * g.position_kp_1_s,
    }


def _margins(m: Margins) -> Document:
    return {**asdict(m), "smaller_gain_margin_dB": smaller_gain_margin_dB(m)}


def _worst(w: Worst, told: tuple[str, ...]) -> Document:
    margins = _margins(w.margins)
    del margins["crossover_hz"]
    return {**margins, "at": {m: {n: x for n, x in motor.items() if n in told} for m, motor in w.at.items()}}


def _response(r: Response, gains: Gains) -> Document:
    position = not isinstance(gains, CascadeGains) or gains.position_kp_1_s is not None
    shown = asdict(r)
    del shown["peak_V"]
    return {**shown, "of": "position_rad" if position else "velocity_rad_s", "peak_V_per_unit": r.peak_V}


def _advice(a: Advice) -> Document:
    return {
        "largest_linear_step": a.largest_step,
        "voltage_per_count_V": a.ripple_V,
        "breakaway_V": a.breakaway_V,
        "notes": list(a.notes),
    }
