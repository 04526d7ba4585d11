"""Another model in the daemon: asked for from outside, done by the worker, kept over a restart."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.daemon import model_coordinator
from servo_daemon.errors import BusyError, ModelError, RefusedError, ServoDaemonError
from servo_daemon.published.view import ModelChange
from tests.daemon_rig import PATIENCE_S, Rig, configuration, starter

FRICTION = ("coulomb_friction",)
Start = Callable[..., Rig]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Rig]]:
    with starter(monkeypatch) as begin:
        yield begin


def tracking(rig: Rig, n: int = 4000) -> Rig:
    rig.driver().feed(n)
    rig.until_samples(n)
    assert rig.statuses() == {"tracking"}
    return rig


def fed_until_done(rig: Rig, future: Future[ModelChange]) -> ModelChange:
    """Samples go on coming while the model is exchanged."""

    def done() -> bool:
        if not future.done():
            rig.driver().feed(100)
        return future.done()

    rig.until(done, "the model is exchanged")
    return future.result(0)


def adopt(rig: Rig, **given: Any) -> ModelChange:
    values = {name: (value, abs(value) * 0.02) for name, value in given.items()}
    return fed_until_done(rig, rig.runtime().request_model(FRICTION, values))


def test_the_model_is_exchanged_and_no_sample_lost(start: Start) -> None:
    rig = tracking(start())
    assert rig.runtime().model == ()
    change = adopt(rig, Tc=0.02)
    assert change.model == FRICTION == rig.runtime().model
    snapshot = rig.snapshot()
    assert snapshot.estimate is not None and snapshot.estimate.model == FRICTION, "published before it is answered"
    assert change.time is not None and snapshot.time is not None and change.time <= snapshot.time
    rig.until_samples(rig.driver().fed)
    snapshot = rig.snapshot()
    assert snapshot.counters["samples"] == snapshot.estimate.samples  # type: ignore[union-attr]
    assert snapshot.counters["samples_lost"] == 0
    parameters = {p.name: p for p in snapshot.estimate.parameters}  # type: ignore[union-attr]
    assert "Tc" in parameters and parameters["R"].status == "tracking"
    assert [p.name for p in rig.runtime().initial_parameters] == ["R", "L", "K", "J", "B", "Tc"]
    assert rig.kinds() == ["connected", "filter_started", "model_changed", "filter_started"]


def test_the_history_keeps_what_the_model_no_longer_has(start: Start) -> None:
    rig = tracking(start(configuration(model=["constant_load_torque"])))
    with_it = len(rig.runtime().history.query("TL"))
    assert with_it > 0
    fed_until_done(rig, rig.runtime().request_model((), {}))
    assert "TL" not in {p.name for p in rig.snapshot().estimate.parameters}  # type: ignore[union-attr]
    assert len(rig.runtime().history.query("TL")) >= with_it


def test_one_change_at_a_time(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = tracking(start())
    first = rig.runtime().request_model(FRICTION, {})
    with pytest.raises(BusyError):
        rig.runtime().request_model((), {})
    fed_until_done(rig, first)
    fed_until_done(rig, rig.runtime().request_model((), {}))
    assert rig.runtime().model == ()


def test_what_cannot_be_is_refused_at_once(start: Start) -> None:
    rig = start()
    with pytest.raises(ModelError):
        rig.runtime().request_model(("flux_capacitor",), {})
    never = start(configuration(estimation={"adopt": "never"}))
    with pytest.raises(RefusedError, match="never"):
        never.runtime().request_model(FRICTION, {})


def test_without_samples_it_is_done_at_once_and_has_no_first_estimate(start: Start) -> None:
    rig = start()
    change = rig.runtime().request_model(FRICTION, {}).result(PATIENCE_S)
    assert change == ModelChange(FRICTION, None)
    assert rig.runtime().model == FRICTION


def test_a_plant_that_cannot_be_made_is_told_and_the_coordinator_open_again(
    start: Start,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = tracking(start())

    def fail(*_: object) -> None:
        raise RuntimeError("made up")

    with monkeypatch.context() as patched:
        patched.setattr(model_coordinator.Pipeline, "prepare", fail)
        with pytest.raises(ServoDaemonError, match="made up"):
            rig.runtime().request_model(FRICTION, {}).result(PATIENCE_S)
    assert adopt(rig).model == FRICTION


def test_a_reset_goes_back_to_the_configured_model(start: Start, tmp_path: Path) -> None:
    rig = tracking(start(state=tmp_path))
    adopt(rig, Tc=0.02)
    rig.until(lambda: "adopted" in saved(tmp_path), "saved")
    rig.runtime().request_reset()
    rig.until(lambda: rig.runtime().model == (), "as configured")
    rig.driver().feed(4000)
    rig.until(lambda: rig.snapshot().estimate is not None and rig.statuses() == {"tracking"}, "tracks again")
    rig.until(lambda: saved(tmp_path).get("model") == [], "saved")
    assert "adopted" not in saved(tmp_path)


def test_a_reset_ends_a_change_that_waits(start: Start) -> None:
    rig = tracking(start())
    future = rig.runtime().request_model(FRICTION, {})
    rig.until(
        lambda: (p := rig.runtime()._estimation._model_changes._pending) is not None and p.begun,
        "begun; no samples come",
    )
    rig.runtime().request_reset()
    with pytest.raises(ServoDaemonError, match="reset"):
        future.result(PATIENCE_S)


def saved(folder: Path) -> dict[str, Any]:
    path = folder / "axis1.state.json"
    return json.loads(path.read_text()) if path.exists() else {}  # type: ignore[no-any-return]


def again(start: Start, state: Path, samples: int = 500, **extra: Any) -> Rig:
    rig = start(configuration(**extra), state=state)
    rig.driver().source.next_block(20_000)
    rig.driver().feed(samples)
    rig.until_samples(samples)
    return rig


def test_an_adopted_model_survives_a_restart_even_before_it_is_known(start: Start, tmp_path: Path) -> None:
    first = tracking(start(state=tmp_path))
    adopt(first, Tc=0.02)
    first.until(lambda: saved(tmp_path).get("model") == ["coulomb_friction"], "saved")
    first.daemon.stop(PATIENCE_S)
    assert saved(tmp_path)["adopted"] == {"configured": [], "nominal": {"Tc": 0.02}}
    second = again(start, tmp_path)
    assert second.runtime().model == FRICTION
    assert {p.name: p.nominal for p in second.snapshot().estimate.parameters}["Tc"] == 0.02  # type: ignore[union-attr]
    assert "model_restored" in second.kinds()
    second.daemon.stop(PATIENCE_S)
    changed = again(start, tmp_path, model=["gravity_load"])
    assert changed.runtime().model == ("gravity_load",), "the user's word is newer"
    assert "model_restored" not in changed.kinds()


def test_what_is_asked_for_before_the_first_samples_wins_over_the_last_run(start: Start, tmp_path: Path) -> None:
    first = tracking(start(state=tmp_path))
    adopt(first, Tc=0.02)
    first.until(lambda: saved(tmp_path).get("model") == ["coulomb_friction"], "saved")
    first.daemon.stop(PATIENCE_S)
    second = start(state=tmp_path)
    assert second.runtime().request_model(("constant_load_torque",), {}).result(PATIENCE_S).time is None
    second.driver().feed(500)
    second.until_samples(500)
    assert second.runtime().model == ("constant_load_torque",)
    assert not {"model_restored", "state_restored"} & set(second.kinds())


def test_estimates_of_an_adopted_model_are_restored_with_it(start: Start, tmp_path: Path) -> None:
    first = tracking(start(state=tmp_path))
    fed_until_done(first, first.runtime().request_model(("constant_load_torque",), {}))
    first.driver().feed(4000)
    first.until(lambda: "TL" in saved(tmp_path).get("names", []), "known and saved")
    first.daemon.stop(PATIENCE_S)
    second = again(start, tmp_path)
    second.until(lambda: "filter_started" in second.kinds(), "started")
    assert second.kinds()[:3] == ["connected", "model_restored", "state_restored"]


def test_alarms_follow_the_model(start: Start) -> None:
    rig = tracking(start(configuration(limits={"R_max": 0.4, "Tc_max": 1.0})))
    assert rig.kinds().count("alarm") == 1 and rig.kinds().count("alarm_impossible") == 1, "there is no Tc"
    adopt(rig, Tc=0.02)
    rig.driver().feed(1000)
    rig.until_samples(rig.driver().fed)
    assert rig.kinds().count("alarm_cleared") == 0 and rig.kinds().count("alarm") == 1, "R rings on"
    assert "R_max" in str(rig.snapshot().estimate.health["alarms"])  # type: ignore[union-attr]
    fed_until_done(rig, rig.runtime().request_model((), {}))
    assert rig.kinds().count("alarm_impossible") == 2, "told again: there is no Tc any more"
