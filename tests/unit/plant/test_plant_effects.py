"""Every effect of the library: its twin, its derivatives, its place in config and command line, and its energy."""

from __future__ import annotations

import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from servo_daemon.config import DriveConfig
from servo_daemon.errors import BadInputError, ConfigError
from servo_daemon.identification.output_error.problem.rollout import free_run, simulate
from servo_daemon.plant import effects as library
from servo_daemon.plant.build import PlantModel, build_plant
from servo_daemon.plant.effects import effects_by_name, parameter_table
from servo_daemon.samples import F64
from servo_daemon.simulate.settings import make_settings, parse_effect, parse_effects
from servo_daemon.tracking.plan.signals import plan_signals
from tests.few_samples import run_uncompiled
from tests.twin import reference_step

#: Each effect's parameters, as docs/model.md lists them.
CONTRACT = {
    "coulomb_friction": "Tc", "asymmetric_friction": "Tc Tc_neg B_neg", "stribeck_friction": "Tc Ts ws",
    "position_dependent_friction": "Tc_slope Tc_curve", "load_dependent_friction": "mu", "quadratic_drag": "c2",
    "gravity_load": "Tg phi_g", "cogging_torque": "Tcog n_cog phi_cog", "torque_ripple": "k_rip n_rip phi_rip",
    "constant_load_torque": "TL", "load_torque_step": "dTL t_TL", "periodic_disturbance": "Tper f_per phi_per",
    "brush_voltage_drop": "Vb", "magnetic_saturation": "I_sat", "winding_heating": "R_th C_th",
    "resistance_step": "dR t_R", "backlash": "gap k_s c_s J_l", "shaft_compliance": "k_s c_s J_l",
    "encoder_eccentricity": "e_enc phi_enc", "current_sensor_offset": "i0", "current_sensor_gain": "g_i",
    "voltage_sensor_offset": "v0", "measurement_delay": "t_d channel", "drive_lag": "t_lag",
    "speed_filter": "t_f",
    "freewheel_drive": "",
}  # fmt: skip
VALUES = {
    "R": 0.4937, "L": 2.2769e-3, "K": 0.30628, "J": 0.009751, "B": 0.51141, "Tc": 0.3, "Tc_neg": 0.5, "B_neg": 0.9,
    "Ts": 0.6, "ws": 1.0, "Tc_slope": 0.1, "Tc_curve": 0.02, "mu": 0.1, "c2": 0.05, "Tg": 0.9, "phi_g": 0.4, "TL": 0.4,
    "Tcog": 0.3, "n_cog": 12, "phi_cog": 0.3, "Tcog_2": 0.1, "n_cog_2": 24, "phi_cog_2": 0.1, "Tcog_3": 0.1,
    "n_cog_3": 36, "phi_cog_3": 0.1, "Tcog_4": 0.1, "n_cog_4": 48, "phi_cog_4": 0.1, "dTL": 0.4, "t_TL": 5.0003,
    "Tper": 0.3, "f_per": 20.0, "phi_per": 1.0, "k_rip": 0.1, "n_rip": 8, "phi_rip": 0.2, "Vb": 1.0, "I_sat": 30.0,
    "R_th": 2.0, "C_th": 3.0, "dR": 0.2, "t_R": 5.0003, "gap": 0.05, "k_s": 800.0, "c_s": 0.3, "J_l": 0.006,
    "e_enc": 0.02, "phi_enc": 0.3, "i0": 0.3, "g_i": 1.1, "v0": 0.5, "t_d": 2.3e-3, "channel": 1.0, "t_lag": 2e-3,
    "t_f": 3e-3,
}  # fmt: skip


def model_with(name: str, *others: str) -> tuple[str, ...]:
    """The effect with what it needs, and the others as far as they go with it."""
    effect = effects_by_name()[name]
    needed = (effect.further,) if effect.further else ("coulomb_friction",) if effect.scales_friction else ()
    brings = {p.name for p in effect.parameters}
    fitting = [n for n in others if not brings & {p.name for p in effects_by_name()[n].parameters}]
    return tuple(dict.fromkeys((*needed, *fitting, name)))


def state_sizes(model: PlantModel) -> F64:
    own = {"filtered_speed_rad_s": 5.0, "twist_rate_rad_s": 2.0, "twist_rad": 0.05, "winding_rise_K": 30.0}
    return np.array([10.0, 5.0, 2.0, *(own.get(s.name, s.scale) for s in model.states[3:])])


def test_the_library_is_the_contract() -> None:
    ours = {n: " ".join(p.name for p in e.parameters) for n, e in effects_by_name().items() if not e.further}
    assert ours == CONTRACT
    assert [n for n, e in effects_by_name().items() if e.further] == [f"cogging_torque_{k}" for k in (2, 3, 4)]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("EFFECTS = ()", "no effect: give it EFFECT"),
        ("from servo_daemon.plant.effects.gravity_load import EFFECT", "two effects are called gravity_load"),
        (
            "from dataclasses import replace\nfrom servo_daemon.plant.effects import gravity_load as g\n"
            "EFFECT = replace(g.EFFECT, name='weight', parameters=(replace(g.TG, nominal=2.0), g.PHI_G))",
            "weight: its parameter Tg is another's, too",
        ),
        (
            "from dataclasses import replace\nfrom servo_daemon.plant.effects.drive_lag import EFFECT as lag\n"
            "EFFECT = replace(lag, name='line', simpler=(('lag',),))",
            "line names lag, which is no effect",
        ),
        (
            "from dataclasses import replace\nfrom servo_daemon.plant.effects.drive_lag import EFFECT as lag\n"
            "EFFECT = replace(lag, name='line', hides={'t_lag': ('L', 't_L')})",
            "line names t_L, which is no parameter",
        ),
    ],
)
def test_a_file_that_is_no_effect_of_its_own_is_refused(
    text: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "of_a_stranger.py").write_text(text, encoding="utf-8")
    monkeypatch.setattr(library, "__path__", [*library.__path__, str(tmp_path)])
    monkeypatch.delitem(sys.modules, "servo_daemon.plant.effects.of_a_stranger", raising=False)
    with pytest.raises(ImportError, match=says):
        library.effects_by_name.__wrapped__()


@pytest.mark.parametrize("name", list(effects_by_name()))
def test_texts(name: str) -> None:
    effect = effects_by_name()[name]
    assert effect.name == name
    assert effect.cause.endswith(".") and effect.cause.count(". ") == 0
    assert effect.equation and effect.equation.count("{") == effect.equation.count("}")
    for p in effect.parameters:
        assert p.unit and p.description and p.symbol and p.lower <= p.nominal <= p.upper


@pytest.mark.parametrize("others", [(), ("coulomb_friction", "gravity_load")], ids=["alone", "with friction"])
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n == "backlash" else ()) for n in effects_by_name()]
)
def test_twin_agrees(name: str, others: tuple[str, ...]) -> None:
    model, rng = build_plant(model_with(name, *others)), np.random.default_rng(7)
    for _ in range(8):
        p = [VALUES[n] * np.exp(rng.normal() * 0.3) if n != "channel" else 1.0 * rng.integers(3) for n in names(model)]
        x = rng.normal(size=len(model.states)) * state_sizes(model)
        u, t, h = rng.normal() * 12, 5 + rng.uniform(-0.003, 0.003), 10 ** rng.uniform(-4, -2)
        ours = np.asarray(model.step(x, u, np.array(p), t, h)).ravel()
        np.testing.assert_allclose(ours, reference_step(model, x, u, np.array(p), t, h), rtol=1e-9, atol=1e-11)


def names(model: PlantModel) -> tuple[str, ...]:
    return model.parameter_names


@pytest.mark.parametrize("name", list(effects_by_name()))
def test_derivatives_are_the_slopes(name: str) -> None:
    """Away from where a mode changes, and of everything the step has a slope in."""
    model, rng = build_plant(model_with(name)), np.random.default_rng(5)
    x_, p_ = ca.SX.sym("x", len(model.states)), ca.SX.sym("p", len(model.parameters))
    stepped = model.step(x_, 5.0, p_, 5.0, 1e-3)
    derive = ca.Function("d", [x_, p_], [ca.jacobian(stepped, x_), ca.jacobian(stepped, p_)])
    for _ in range(5):
        x = rng.normal(size=len(model.states)) * state_sizes(model) * 0.1
        x[:2] += [15.0, 20.0]
        if "twist_rad" in model.state_names:  # well in contact
            x[model.state_names.index("twist_rad")] = 0.06
        p = np.array([VALUES[n] for n in names(model)])
        for k, (point, slopes) in enumerate(zip((x, p), derive(x, p), strict=True)):
            for j in range(len(point)):
                if k == 1 and names(model)[j] == "channel":
                    continue
                d = 1e-5 * max(1e-2, abs(point[j]))
                up, down = ([x.copy(), p.copy()] for _ in range(2))
                up[k][j] += d
                down[k][j] -= d
                pair = [np.asarray(model.step(a[0], 5.0, a[1], 5.0, 1e-3)).ravel() for a in (up, down)]
                slope = (pair[0] - pair[1]) / (2 * d)
                largest = np.abs(slope).max()
                np.testing.assert_allclose(np.asarray(slopes)[:, j], slope, rtol=1e-3, atol=1e-4 * largest + 1e-8)


@pytest.mark.parametrize("drive", ["current", "torque"])
@pytest.mark.parametrize("name", list(effects_by_name()))
def test_other_inputs(name: str, drive: str) -> None:
    """An effect on the armature says nothing without a voltage; none breaks the shaft's model."""
    model = build_plant(model_with(name), drive)  # type: ignore[arg-type]
    p = [VALUES[n] for n in names(model)]
    after = np.asarray(model.step(np.zeros(len(model.states)), 3.0, p, 5.0, 1e-3)).ravel()
    assert np.isfinite(after).all() and after[0] > 0


@pytest.mark.parametrize(
    "effects, says",
    [
        (("position_dependent_friction",), "position_dependent_friction varies a dry friction: the model needs one of"),
        (("coulomb_friction", "stribeck_friction"), "coulomb_friction and stribeck_friction are the same dry friction"),
        (("backlash", "shaft_compliance"), "backlash and shaft_compliance are the same second inertia"),
        (("cogging_torque_2",), "cogging_torque_2 is a further harmonic of cogging_torque: name that, too"),
    ],
)
def test_what_does_not_go_together_is_refused(effects: tuple[str, ...], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        build_plant(effects)
    with pytest.raises(ValueError, match=says):
        DriveConfig(model=effects)


def test_harmonics_by_the_first_ones_name() -> None:
    found, values = parse_effects(["cogging_torque:Tcog=0.3,n_cog=12,Tcog_3=0.1,n_cog_3=36"])
    assert found == ("cogging_torque", "cogging_torque_3")
    assert values == {"Tcog": 0.3, "n_cog": 12.0, "Tcog_3": 0.1, "n_cog_3": 36.0}
    with pytest.raises(BadInputError, match="cogging_torque_2 is named twice"):
        parse_effects(["cogging_torque:Tcog_2=0.1", "cogging_torque_2:Tcog_2=0.1"])


def test_a_channel_by_its_name() -> None:
    assert parse_effect("measurement_delay:t_d=1e-3,channel=current_A")[1] == {"t_d": 1e-3, "channel": 0.0}
    assert parse_effect("measurement_delay:channel=2")[1] == {"channel": 2.0}
    for channel in ("tacho", "0.5"):
        with pytest.raises(BadInputError, match=f"channel = '?{channel}'? is none of current_A, position_rad"):
            parse_effect(f"measurement_delay:channel={channel}")
    assert DriveConfig(nominal={"channel": "velocity_rad_s"}).nominal == {"channel": 2.0}  # type: ignore[dict-item]


@pytest.mark.parametrize("name", list(effects_by_name()))
def test_the_simulator_takes_it(name: str) -> None:
    """With the value that shows where none is given."""
    settings = make_settings(effects=model_with(name), seconds=1.0)
    assert np.isfinite(settings.ageing.start).all()


def test_live_filters_hold_what_they_cannot_search() -> None:
    effects = ("cogging_torque", "load_torque_step", "measurement_delay")
    plan = plan_signals(("voltage_V", "current_A", "position_rad"), effects, {"n_cog": 24.0, "t_TL": 5.0})
    assert plan.held == {"n_cog": 24.0, "t_TL": 5.0, "channel": 1.0}
    assert not set(plan.held) & set(plan.free) and set(plan.held) <= set(plan.reasons)
    assert {"Tcog", "phi_cog", "dTL", "t_d"} <= set(plan.free)
    assert plan.known == {}


@pytest.mark.parametrize(
    ("effect", "size", "instant"), [("load_torque_step", "dTL", "t_TL"), ("resistance_step", "dR", "t_R")]
)
def test_a_step_without_its_instant_is_held(effect: str, size: str, instant: str) -> None:
    """From the first sample on it would be one with what it changes: the filter then shares the true step out among
    the two and is sure of both."""
    plan = plan_signals(("voltage_V", "current_A", "position_rad"), (effect,), {})
    assert plan.held[size] == 0.0 and instant in plan.reasons[size]
    assert size in plan_signals(("voltage_V", "current_A", "position_rad"), (effect,), {instant: 3.0}).free


def test_what_is_held_and_how() -> None:
    held = {p.name: p.held for p in parameter_table().values() if p.searched}
    always = {"channel", "n_rip", *(f"n_cog{k}" for k in ("", "_2", "_3", "_4"))}
    assert held == {**dict.fromkeys(("t_TL", "t_R", "f_per", "gap"), "live"), **dict.fromkeys(always, "always")}


@pytest.mark.parametrize("name", ["shaft_compliance", "backlash"])
def test_a_second_inertia_never_gains_energy(name: str) -> None:
    """Any stiffness within bounds, any damping, any sampling: left alone, the energy only falls."""
    model, rng = build_plant((name,)), np.random.default_rng(0)
    pushed, n = 100, 400
    for _ in range(60):
        v = {"R": 1.13, "L": 3.3e-4, "K": 0.06, "J": 4e-5, "B": 1e-10, "k_s": 10 ** rng.uniform(-6, 9)}
        v |= {"c_s": 10 ** rng.uniform(-10, 5), "J_l": 10 ** rng.uniform(-10, 3), "gap": 10 ** rng.uniform(-6, 0.5)}
        h = 10 ** rng.uniform(-5, -1.3)
        u = np.where(np.arange(n) < pushed, rng.normal(size=n) * 10, 0.0)
        rows = np.column_stack([np.arange(n) * h, np.full(n, h), u])
        q = np.log([v[k] for k in names(model)])
        i, omega, _, rate, twist = free_run(model, ("position_rad",), q, np.zeros(5), rows)[1].T
        edge = v["gap"] / 2 if name == "backlash" else 0.0
        energy = v["L"] * i**2 + v["J"] * omega**2 + v["J_l"] * (omega - rate) ** 2
        energy += v["k_s"] * np.maximum(np.abs(twist) - edge, 0.0) ** 2
        assert np.isfinite(energy).all() and energy[pushed] > 0
        assert np.max(np.diff(energy[pushed + 5 :])) < 1e-9 * np.max(energy)


def test_a_sticking_motor_does_not_creep_behind_a_swinging_load() -> None:
    """The load swings on its spring below the breakaway level: the motor returns to where it was with every swing."""
    model = build_plant(("coulomb_friction", "shaft_compliance"))
    v = VALUES | {"Tc": 3.0, "k_s": 50.0, "c_s": 1e-9, "J_l": 0.006}
    rows = np.column_stack([np.arange(20000) * 1e-3, np.full(20000, 1e-3), np.zeros(20000)])
    x0 = np.array([0.0, 0.0, 1.0, 0.0, 0.03])
    states = free_run(model, ("position_rad",), np.log([v[k] for k in names(model)]), x0, rows)[1]
    assert np.ptp(states[-2000:, 4]) > 0.05  # it still swings
    assert np.max(np.abs(states[:, 2] - 1.0)) < 1e-3 * 0.06  # to and fro within a step, of second order in it
    assert abs(np.mean(states[-2000:, 2]) - np.mean(states[:2000, 2])) < 1e-6


def test_brushes_block_the_current_below_their_drop() -> None:
    model = build_plant(("brush_voltage_drop", "coulomb_friction", "constant_load_torque"))
    v = VALUES | {"TL": 0.2}
    p = np.array([v[k] for k in names(model)])
    x = np.zeros(3)
    for k in range(200):
        x = np.asarray(model.step(x, 0.95 * v["Vb"], p, k * 1e-3, 1e-3)).ravel()
    assert np.max(np.abs(x)) < 1e-4
    for k in range(2000):
        x = np.asarray(model.step(x, 6.0, p, k * 1e-3, 1e-3)).ravel()
    assert v["R"] * x[0] + v["K"] * x[1] == pytest.approx(6.0 - v["Vb"], rel=1e-6)
    assert v["K"] * x[0] - v["B"] * x[1] == pytest.approx(v["Tc"] + v["TL"], rel=1e-6)


@pytest.mark.parametrize("delay_s", [3e-4, 1e-3, 1.00001e-3, 2.4e-3, 6.5e-3])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_a_late_channel_is_the_run_itself_earlier(channel: int, delay_s: float) -> None:
    """Against a run on a grid ten times as fine of the motor without a delay."""
    rng = np.random.default_rng(2)
    coarse, fine = 200, 10
    u = rng.normal(size=coarse) * 10
    plain, late = build_plant(()), build_plant(("measurement_delay",))
    rows = np.column_stack([np.arange(coarse) * 1e-3, np.full(coarse, 1e-3), u])
    t = np.arange(coarse * fine) * 1e-3 / fine
    dense = np.column_stack([t, np.full(len(t), 1e-3 / fine), np.repeat(u, fine)])
    q = np.log([VALUES[k] for k in names(plain)])
    truth = free_run(plain, ("position_rad",), q, np.zeros(3), dense)[1][:, (0, 2, 1)[channel]]
    shown_as = ("current_A", "position_rad", "velocity_rad_s")[channel]
    own = [*q, np.log(delay_s), channel]
    shown = free_run(late, (shown_as,), np.array(own), np.zeros(len(late.states)), rows)[0][:, 0]
    wanted = np.interp(rows[20:, 0] - delay_s, t, truth)
    np.testing.assert_allclose(shown[20:], wanted, atol=2e-3 * np.std(truth))


@pytest.mark.parametrize("delay_s", [8e-4, 1e-3, 2e-3, 5.9e-3])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_a_late_channel_under_jittered_time_stamps(channel: int, delay_s: float) -> None:
    """Also with samples missing: the motor without a delay, stopped at the very instants that are wanted.

    RE 40: L/R is 0.3 samples, the current settles within one, and 1e-4 of a sample's travel is a thirtieth of a count.
    """
    rng = np.random.default_rng(2)
    own = {"R": 0.299, "L": 8.2e-5, "K": 0.0302, "J": 1.42e-5, "B": 3e-6}
    time = np.delete(np.arange(300) * 1e-3 + rng.normal(size=300) * 14e-6, [100, 200, 201])
    u = rng.normal(size=len(time)) * 10
    wanted = time - delay_s
    grid = np.unique(np.r_[time, wanted[wanted > time[0]]])
    held = u[np.searchsorted(time, grid, side="right") - 1]
    plain, late = build_plant(()), build_plant(("measurement_delay",))
    q = np.log([own[k] for k in names(plain)])
    dense = np.column_stack([grid, np.diff(grid, append=grid[-1] + 1e-3), held])
    truth = free_run(plain, ("position_rad",), q, np.zeros(3), dense)[1][:, (0, 2, 1)[channel]]
    rows = np.column_stack([time, np.diff(time, append=time[-1] + 1e-3), u])
    shown_as = ("current_A", "position_rad", "velocity_rad_s")[channel]
    shown = free_run(late, (shown_as,), np.array([*q, np.log(delay_s), channel]), np.zeros(len(late.states)), rows)[0]
    at = np.searchsorted(grid, wanted[10:])
    np.testing.assert_allclose(shown[10:, 0], truth[at], rtol=0, atol=1e-7 * np.std(truth))


def test_a_late_channel_is_finite_after_any_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two stamps in a nanosecond, a pause of a minute, a motor that has come to rest long before."""
    run_uncompiled(monkeypatch)
    late = build_plant(("measurement_delay",))
    q = [np.log(VALUES[k]) if k != "channel" else 0.0 for k in names(late)]
    for channel in range(3):
        rows = np.array([[0.0, h, 5.0] for h in (1e-3, 1e-9, 1e-3, 60.0, 1e-3, 1e-3, 0.0, 1e-3)])
        q[-1] = channel
        run = simulate(late, ("current_A", "position_rad"), np.array(q), np.zeros(len(late.states)), rows)
        assert np.isfinite(run.shown).all() and np.isfinite(run.by_parameter).all()


@pytest.mark.parametrize(
    "effects",
    [(), ("cogging_torque",), ("stribeck_friction",), ("torque_ripple",), ("magnetic_saturation",)],
    ids=lambda effects: "+".join(effects) or "linear",
)
def test_noise_of_the_voltage_does_what_the_voltage_does(effects: tuple[str, ...]) -> None:
    """Of a winding that settles within a sample (RE 40 at 1 kHz) most of what the first parts of a step have done to
    the current is gone at its end: simply added up it was 1.7 times too much in two parts, 2.5 times in four."""
    plant = build_plant(effects)
    motor = {"R": 1.13, "L": 0.33e-3, "K": 60.3e-3, "J": 4e-5, "B": 3e-5}
    p = np.array([motor.get(q.name, q.nominal) for q in plant.parameters])
    x, h, by = np.array([0.1, 10.0, 0.3]), 1e-3, 1e-4
    above, below = (np.array(plant.step(x, 1.0 + du, p, 0.0, h))[:, 0] for du in (by, -by))
    gain = np.array(plant.noise_gain(x, 1.0, p, 0.0, h))
    assert gain[:, 0] == pytest.approx((above - below) / (2 * by), rel=0.01)
    linear = build_plant(())
    expected = np.array(linear.noise_gain(x, 1.0, [motor[q.name] for q in linear.parameters], 0.0, h))
    assert gain == pytest.approx(expected, rel=0.01)


def test_a_lagging_voltage_into_a_winding_that_settles_within_a_sample() -> None:
    """RE 40 at 1 kHz, a lag of 4 ms: in one step 1.4 mA of 2 A off, in four 7 µA; against steps of 10 µs."""
    plant = build_plant(("drive_lag",))
    motor = {"R": 1.13, "L": 0.33e-3, "K": 60.3e-3, "J": 4e-5, "B": 3e-5, "t_lag": 4e-3}
    p, h = np.array([motor[q.name] for q in plant.parameters]), 1e-3
    coarse = fine = np.zeros(len(plant.states))
    worst = 0.0
    for u in np.random.default_rng(2).normal(size=200) * 10.0:
        coarse = np.array(plant.step(coarse, u, p, 0.0, h))[:, 0]
        for _ in range(100):
            fine = np.array(plant.step(fine, u, p, 0.0, h / 100))[:, 0]
        worst = max(worst, abs(float(coarse[0] - fine[0])))
    assert worst < 1e-4


@pytest.mark.parametrize("omega", [100.0, 300.0, 600.0])
def test_a_fast_ripple_is_followed_within_a_sample(omega: float) -> None:
    """An RE 40 whose commutator passes 0.13 to 0.76 times a sample, against an integrator with error control. The mean
    of the constant over a part of the sample alone leaves 3 to 12 times as much, and a fit to it an L 7 to 11 % off."""
    p = {"R": 1.13, "L": 0.33e-3, "K": 0.0603, "J": 4e-5, "B": 3e-5, "k_rip": 0.2, "n_rip": 8.0, "phi_rip": 0.7}
    u, h, n = p["K"] * omega + p["R"], 1e-3, 20

    def rates(_t: float, x: F64) -> list[float]:
        K = p["K"] * (1 + p["k_rip"] * np.sin(p["n_rip"] * x[2] + p["phi_rip"]))
        return [(u - p["R"] * x[0] - K * x[1]) / p["L"], (K * x[0] - p["B"] * x[1]) / p["J"], x[1]]

    begin = np.array([1.0, omega, 0.0])
    times = np.arange(1, n + 1) * h
    exact = solve_ivp(rates, (0.0, n * h), begin, "DOP853", times, rtol=1e-10, atol=1e-12).y.T
    model, x, errors = build_plant(("torque_ripple",)), begin, []
    values = np.array([p[name] for name in names(model)])
    for k in range(n):
        x = np.asarray(model.step(x, u, values, k * h, h)).ravel()
        errors.append(x - exact[k])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    most = {100.0: (1e-3, 2e-3), 300.0: (4e-3, 3e-2), 600.0: (4e-2, 0.2)}[omega]
    assert rms[0] < most[0] and rms[1] < most[1], rms
