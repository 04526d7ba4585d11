"""Another model while the drive runs: what may be asked for, what is kept of the old one, what is said meanwhile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servo_daemon.config import DriveConfig
from servo_daemon.errors import ModelError
from servo_daemon.pipeline.model_change import ModelRequest, adopted_effects, checked_request
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.plant.effects import effects_by_name
from servo_daemon.published.snapshot import Estimate, ParameterEstimate
from servo_daemon.samples import SampleBlock, make_block
from servo_daemon.simulate import DEFAULT_NOMINAL, PAPER_MOTOR, SimulatedDrive, make_settings

FRICTION = ("coulomb_friction",)


@pytest.mark.parametrize(
    ("effects", "start", "where", "text"),
    [
        (("coulomb_fricton",), {}, "effects.0", "no effect 'coulomb_fricton'; there are coulomb_friction, "),
        (("gravity_load", "x"), {}, "effects.1", "no effect 'x'"),
        (("coulomb_friction", "asymmetric_friction"), {}, "effects", "a model has one of them"),
        (("coulomb_friction", "coulomb_friction"), {}, "effects", "named twice"),
        (("position_dependent_friction",), {}, "effects", "needs one of"),
        (FRICTION, {"Ts": (0.1, None)}, "parameters.Ts", "this model has R, L, K, J, B, Tc, and no 'Ts'"),
        (FRICTION, {"Tc": (-0.1, None)}, "parameters.Tc", "outside"),
        (FRICTION, {"Tc": (float("nan"), None)}, "parameters.Tc", "outside"),
        (FRICTION, {"Tc": (0.1, -1.0)}, "parameters.Tc", "makes no sense"),
        (FRICTION, {"Tc": (0.1, float("inf"))}, "parameters.Tc", "makes no sense"),
        (FRICTION, {"Tc": ("much", None)}, "parameters.Tc", "'much' is none of"),
        (FRICTION, {"Tc": ("0.1", None)}, "parameters.Tc", "'0.1' is none of"),
        (FRICTION, {"Tc": (True, None)}, "parameters.Tc", "True is not a number"),
        (("measurement_delay",), {"channel": (0.5, None)}, "parameters.channel", "0.5 is none of current_A"),
        (("measurement_delay",), {"channel": ("voltage_V", None)}, "parameters.channel", "'voltage_V' is none of"),
    ],
)
def test_what_no_drive_can_have_is_refused_by_name(
    effects: tuple[str, ...], start: dict[str, tuple[float | str, float | None]], where: str, text: str
) -> None:
    with pytest.raises(ModelError) as error:
        checked_request(effects, start)
    assert error.value.where == where
    assert text in str(error.value) and "\n" not in str(error.value)


def test_a_model_is_to_the_configuration_what_its_lines_would_be() -> None:
    config = DriveConfig(nominal={"R": 1.0, "n_cog": 7.0, "Tcog": 0.5})
    request = checked_request(
        ("cogging_torque", "measurement_delay"),
        {"R": (2.0, 0.1), "Tcog": (0.1, None), "n_cog": (12.0, None), "channel": ("position_rad", None)},
    )
    changed = request.configure(config)
    assert changed.model == ("cogging_torque", "measurement_delay")
    assert changed.nominal["R"] == 1.0, "the datasheet's stays the datasheet's"
    assert changed.nominal["Tcog"] == 0.5
    assert changed.nominal["n_cog"] == 12.0, "what no filter can search for is held at the newer value"
    assert effects_by_name()["measurement_delay"].parameters[1].choices[int(changed.nominal["channel"])] == (
        "position_rad"
    )
    assert config.model == () and config.nominal["n_cog"] == 7.0


@pytest.mark.parametrize(
    ("model", "found", "adopted"),
    [
        ((), ("coulomb_friction",), ("coulomb_friction",)),
        (("gravity_load",), ("coulomb_friction",), ("gravity_load", "coulomb_friction")),
        (("coulomb_friction", "gravity_load"), ("stribeck_friction",), ("gravity_load", "stribeck_friction")),
        (("coulomb_friction",), ("coulomb_friction", "gravity_load"), ("coulomb_friction", "gravity_load")),
        ((), ("load_torque_step",), ("constant_load_torque",)),
        (("constant_load_torque",), ("load_torque_step", "resistance_step"), ("constant_load_torque",)),
        (("shaft_compliance",), ("backlash",), ("backlash",)),
    ],
)
def test_what_is_found_joins_the_model(
    model: tuple[str, ...], found: tuple[str, ...], adopted: tuple[str, ...]
) -> None:
    assert adopted_effects(model, found) == adopted


def test_an_effect_of_another_version_is_not_adopted() -> None:
    with pytest.raises(ModelError, match="flux_capacitor"):
        adopted_effects((), ("flux_capacitor",))


# -- the pipeline ------------------------------------------------------------------------------------------------


def rows(pipeline: Pipeline, drive: SimulatedDrive, seconds: float, size: int = 100) -> list[Estimate]:
    out: list[Estimate] = []
    for _ in range(round(seconds * 1000 / size)):
        out += pipeline.process(drive.next_block(size))
    assert all(e.is_finite for e in out)
    return out


def by_name(estimate: Estimate) -> dict[str, ParameterEstimate]:
    return {p.name: p for p in estimate.parameters}


def exchange(pipeline: Pipeline, request: ModelRequest) -> None:
    config = request.configure(pipeline.config)
    pipeline.change_model(request, config, pipeline.prepare(config))


def running(
    effects: tuple[str, ...] = (), model: tuple[str, ...] = (), seconds: float = 6.0, **sim: object
) -> tuple[Pipeline, SimulatedDrive, Estimate]:
    drive = SimulatedDrive(make_settings(seed=4, effects=effects, **sim))  # type: ignore[arg-type]
    pipeline = Pipeline(DriveConfig(model=model, nominal=dict(DEFAULT_NOMINAL)), drive.info)
    return pipeline, drive, rows(pipeline, drive, seconds)[-1]


def test_nothing_is_interrupted_and_nothing_claimed_too_early() -> None:
    """The old model speaks until the new one's filter has settled; what both have stays known; what is new is not
    tracking before it has qualified."""
    pipeline, drive, before = running(("coulomb_friction:Tc=0.15",), seconds=12.0)
    known = {n for n, p in by_name(before).items() if p.status == "tracking"}
    assert {"R", "K"} <= known
    exchange(pipeline, checked_request(FRICTION, {}))
    after = rows(pipeline, drive, 12.0)
    samples = [e.samples for e in after]
    assert np.abs(np.diff(samples) - 100).max() <= 1 and samples[0] > before.samples, "one each tick, with jitter"
    first = next(k for k, e in enumerate(after) if e.model == FRICTION)
    assert 0 < first <= 50
    assert {e.model for e in after[:first]} == {()} and {e.model for e in after[first:]} == {FRICTION}
    for e in after:
        for name in ("R", "K"):
            p = by_name(e)[name]
            assert p.status == "tracking" and p.value == pytest.approx(PAPER_MOTOR[name], rel=0.05)
        if e.model and by_name(e)["Tc"].status == "tracking":
            p = by_name(e)["Tc"]
            assert p.value is not None and p.std is not None and p.std < 0.15 * p.value
    last = by_name(after[-1])
    assert {p.status for p in last.values()} == {"tracking"}
    assert last["Tc"].value == pytest.approx(0.15, rel=0.1) and last["B"].value == pytest.approx(0.51141, rel=0.05)
    assert after[-1].health["innovation_white"] is True and after[-1].health["filter_restarts"] == 0
    kinds = [kind for kind, _, _ in pipeline.messages]
    assert kinds.count("model_changed") == 1 and kinds.count("filter_started") == 2


def test_a_given_value_starts_the_parameter_and_its_std_is_believed() -> None:
    pipeline, drive, _ = running(("coulomb_friction:Tc=0.15",), seconds=8.0)
    exchange(pipeline, checked_request(FRICTION, {"Tc": (0.15, 0.003), "B": (0.511, 0.005), "J": (0.00975, 1e-4)}))
    after = rows(pipeline, drive, 3.0)
    first = next(e for e in after if e.model == FRICTION)
    assert first.time_s - after[0].time_s < 1.5, "nothing has to be found first"
    assert first.estimators["ekf"].parameters["Tc"][0] == pytest.approx(0.15, rel=0.06)
    assert by_name(first)["Tc"].nominal == 0.15
    assert {p.status for p in after[-1].parameters} == {"tracking"}


@pytest.mark.parametrize("size", [7, 1000])
def test_it_does_not_depend_on_the_blocks(size: int) -> None:
    def run(n: int) -> list[Estimate]:
        drive = SimulatedDrive(make_settings(seed=4, effects=("coulomb_friction",)))
        pipeline = Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), drive.info)
        whole = drive.next_block(8000)
        out: list[Estimate] = []
        for a, b, step in ((0, 4200, n), (4200, 8000, n)):
            out += _process(pipeline, whole.slice(a, b), step)
            if a == 0:
                exchange(pipeline, checked_request(FRICTION, {"Tc": (0.3, 0.03)}))
        return out

    assert run(size) == run(100)


def _process(pipeline: Pipeline, block: SampleBlock, step: int) -> list[Estimate]:
    out: list[Estimate] = []
    for k in range(0, len(block), step):
        out += pipeline.process(block.slice(k, min(k + step, len(block))))
    return out


def test_a_motor_that_stands_still_is_not_forgotten() -> None:
    pipeline, drive, moving = running()
    assert {p.status for p in moving.parameters} == {"tracking"}
    last = drive.next_block(1)
    rng = np.random.default_rng(1)

    def standing(start_s: float, n: int) -> SampleBlock:
        assert last.position_rad is not None
        return make_block(
            start_s + 1e-3 * np.arange(1, n + 1),
            voltage_V=np.zeros(n),
            current_A=0.06 * rng.standard_normal(n),
            position_rad=np.full(n, last.position_rad[0]),
        )

    at = float(last.time_s[0])
    still = pipeline.process(standing(at, 8000))[-1]
    assert {p.status for p in still.parameters} == {"unexcited"}
    exchange(pipeline, checked_request(FRICTION, {"Tc": (0.2, 0.02)}))
    after = pipeline.process(standing(at + 8.0, 8000))[-1]
    assert after.model == FRICTION
    for name in ("R", "K", "J", "B"):
        p, was = by_name(after)[name], by_name(still)[name]
        assert p.status == "unexcited" and p.value == pytest.approx(was.value, rel=0.1)
        assert p.std is not None and was.std is not None and p.std >= was.std, "the new effect may have biased it"
    assert by_name(after)["Tc"].status == "estimating"


def test_a_temperature_is_carried_over() -> None:
    heating = ("winding_heating:R_th=2,C_th=15",)
    pipeline, drive, before = running(heating, ("winding_heating",), seconds=15.0)
    rise = before.state["winding_rise_K"]
    assert rise is not None and rise > 2.0
    both = ("winding_heating", "coulomb_friction")
    exchange(pipeline, checked_request(both, {}))
    first = next(e for e in rows(pipeline, drive, 6.0) if e.model == both)
    assert first.state["winding_rise_K"] == pytest.approx(rise, abs=0.3 * rise + 1.0)


def test_back_to_a_smaller_model() -> None:
    pipeline, drive, before = running(("coulomb_friction:Tc=0.15",), FRICTION, seconds=8.0)
    assert "Tc" in by_name(before)
    exchange(pipeline, checked_request((), {}))
    after = rows(pipeline, drive, 6.0)[-1]
    assert after.model == () and list(by_name(after)) == [*PAPER_MOTOR, "J_d"]


def test_before_the_first_samples_it_is_simply_the_model() -> None:
    drive = SimulatedDrive(make_settings(seed=4, effects=("coulomb_friction:Tc=0.15",)))
    pipeline = Pipeline(DriveConfig(nominal=dict(DEFAULT_NOMINAL)), drive.info)
    exchange(pipeline, checked_request(FRICTION, {}))
    assert pipeline.config.model == FRICTION and [m[0] for m in pipeline.messages] == ["model_changed"]
    assert {e.model for e in rows(pipeline, drive, 0.5)} == {FRICTION}


def test_before_the_filter_runs_there_is_nothing_to_keep() -> None:
    pipeline, drive, before = running(seconds=0.5)
    assert {p.status for p in before.parameters} == {"estimating"}
    exchange(pipeline, checked_request(FRICTION, {}))
    # It starts from a guess: nothing qualifies before its re-linearisation, nor while values that have jumped since are
    # gone over again, from 4 s after its start on.
    after = rows(pipeline, drive, 9.0)
    assert after[-1].model == FRICTION and by_name(after[-1])["R"].status == "tracking"


def test_channels_that_change_meanwhile_do_not_lose_it() -> None:
    pipeline, drive, _ = running()
    exchange(pipeline, checked_request(FRICTION, {}))
    pipeline.process(replace(drive.next_block(1000), current_A=None))
    assert pipeline.config.model == FRICTION
    rows(pipeline, drive, 1.0)


def test_a_reset_drops_what_was_not_done_yet() -> None:
    pipeline, drive, _ = running()
    config = pipeline.config
    exchange(pipeline, checked_request(FRICTION, {}))
    rows(pipeline, drive, 0.3)
    pipeline.reset()
    assert {e.model for e in rows(pipeline, drive, 3.0)} == {()} and pipeline.config is config
