"""Alarms on published parameters: by themselves, in a drive, and in what API and metrics show of them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, ClassVar

import pytest

from drivers.base import DriveInfo, Driver
from servo_daemon.api import documents
from servo_daemon.config import DriveConfig, parse_config
from servo_daemon.daemon.drive import DriveRuntime
from servo_daemon.errors import ConfigError
from servo_daemon.pipeline.alarms import Alarms
from servo_daemon.published.metrics import render_metrics
from servo_daemon.published.snapshot import Estimate, ParameterEstimate, Status
from servo_daemon.samples import SampleBlock
from servo_daemon.simulate import DEFAULT_NOMINAL, PAPER_MOTOR, SimulatedDrive, make_settings
from tests.fake_daemon import fake_daemon, make_estimate, make_snapshot


def configuration(limits: Mapping[str, float | str], **more: Any) -> DriveConfig:
    drive = {"name": "axis1", "driver": "fed", "nominal": {"R": 1.0, "J": 3.0}, "limits": dict(limits)} | more
    return parse_config({"drive": [drive]}).drive[0]


def one(value: float | None, std: float | None = 0.1, status: Status = "tracking", name: str = "R") -> Estimate:
    return make_estimate(5.0, [ParameterEstimate(name, value, std, "Ω", 1.0, status, age_s=0.4)])


def kinds(alarms: Alarms, *estimates: Estimate) -> list[str]:
    return [kind for e in estimates for kind, _, _ in alarms.update(e)]


def ringing(alarms: Alarms) -> str | None:
    return alarms.active


def test_rings_beyond_and_ends_inside_by_two_standard_deviations() -> None:
    alarms = Alarms(configuration({"R_max": 2.0}))
    assert kinds(alarms, one(1.0), one(2.1), one(2.19)) == [] and ringing(alarms) is None
    assert kinds(alarms, one(2.21)) == ["alarm"] and ringing(alarms) == "R_max"
    assert kinds(alarms, one(3.0), one(1.9), one(1.81)) == [] and ringing(alarms) == "R_max", "it rings on, told once"
    assert kinds(alarms, one(1.79)) == ["alarm_cleared"] and ringing(alarms) is None
    assert kinds(alarms, one(2.21, 0.2)) == [], "less well known, further beyond"


def test_what_is_told() -> None:
    alarms = Alarms(configuration({"R_max": "+30 %"}))
    [(kind, text, data)] = alarms.update(one(1.55))
    assert (kind, text) == ("alarm", "R = 1.55 Ω is above its limit R_max = 1.3 Ω")
    assert data == {
        "alarm": "R_max",
        "parameter": "R",
        "unit": "Ω",
        "value": 1.55,
        "std": 0.1,
        "limit": pytest.approx(1.3),
        "age_s": 0.4,
        "time_s": 5.0,
    }
    [(kind, text, _)] = alarms.update(one(1.0))
    assert (kind, text) == ("alarm_cleared", "R = 1 Ω is back below its limit R_max = 1.3 Ω")


def test_a_lower_limit_rings_below() -> None:
    alarms = Alarms(configuration({"R_min": "-30 %"}))
    assert kinds(alarms, one(9.0), one(0.55)) == []
    [(_, text, _)] = alarms.update(one(0.45))
    assert text == "R = 0.45 Ω is below its limit R_min = 0.7 Ω"


def test_a_share_is_of_the_nominal_values_size() -> None:
    limits = {"TL_max": "+50 %", "TL_min": "-50 %"}
    alarms = Alarms(configuration(limits, model=["constant_load_torque"], nominal={"TL": -2.0}))
    assert kinds(alarms, one(-2.0, name="TL"), one(-2.9, name="TL"), one(-1.1, name="TL")) == []
    assert kinds(alarms, one(-0.5, name="TL")) == ["alarm"] and ringing(alarms) == "TL_max"


@pytest.mark.parametrize("status", ["estimating", "at_bound", "fixed", "invalid"])
def test_what_is_not_known_changes_nothing(status: Status) -> None:
    alarms = Alarms(configuration({"R_max": 2.0}))
    assert kinds(alarms, one(9.0, status=status), one(9.0, None), one(None, None)) == []
    assert kinds(alarms, one(9.0, status="unexcited")) == ["alarm"]
    assert kinds(alarms, one(1.0, status=status), one(1.0, None), one(None, None)) == []
    assert ringing(alarms) == "R_max"


def test_the_load_alone_has_limits_too() -> None:
    alarms = Alarms(configuration({"J_d_max": "+50 %", "J_d_min": 0.5}, nominal={"J": 3.0, "J_m": 1.0}))
    assert kinds(alarms, one(2.9, name="J_d")) == []
    assert kinds(alarms, one(3.3, name="J_d")) == ["alarm"] and ringing(alarms) == "J_d_max"
    assert kinds(alarms, one(0.1, name="J_d")) == ["alarm_cleared", "alarm"] and ringing(alarms) == "J_d_min"


@pytest.mark.parametrize(
    ("limit", "why"),
    [
        ({"K_max": "+30 %"}, "the alarm K_max cannot work: it is relative to a nominal value"),
        ({"Tc_max": 0.1}, "the alarm Tc_max cannot work: Tc is no parameter of this drive's model"),
        ({"J_d_max": 0.1}, "the alarm J_d_max cannot work: J_d is published only where"),
    ],
)
def test_an_alarm_that_cannot_work_is_told(limit: dict[str, float | str], why: str) -> None:
    alarms = Alarms(configuration(limit | {"R_max": 2.0}))
    [(kind, text, data)] = alarms.impossible
    assert kind == "alarm_impossible" and text.startswith(why) and data == {"alarm": next(iter(limit))}
    assert kinds(alarms, one(9.0)) == ["alarm"], "the others work"


@pytest.mark.parametrize("limit", [float("nan"), "1.2.3 %", "+1e999 %"])
def test_a_limit_that_is_no_number_is_refused(limit: float | str) -> None:
    with pytest.raises(ConfigError, match=r"limits: 'R_max' must be a number or a text such as \"\+30 %\", not "):
        configuration({"R_max": limit})


def test_forgotten_alarms_end_and_may_ring_again() -> None:
    alarms = Alarms(configuration({"R_max": 2.0, "R_min": 0.5}))
    estimate = one(9.0)
    assert alarms.forget("reset") == [] and kinds(alarms, estimate) == ["alarm"]
    assert kinds(alarms, estimate) == [], "nothing new"
    [(kind, text, _)] = alarms.forget("estimates were reset")
    assert (kind, text) == ("alarm_cleared", "alarm R_max is forgotten: estimates were reset")
    assert ringing(alarms) is None and kinds(alarms, estimate) == ["alarm"]


class Idle(Driver):
    """A drive whose samples the test puts into the queue itself."""

    kind: ClassVar[str] = "idle"

    def __init__(self, source: SimulatedDrive) -> None:
        super().__init__("axis1", {})
        self._source = source

    @property
    def info(self) -> DriveInfo:
        return self._source.info

    def _open(self) -> None: ...

    def _read(self, timeout_s: float) -> SampleBlock | None:
        return None

    def _close(self) -> None: ...


def test_a_drive_tells_its_alarms(caplog: pytest.LogCaptureFixture) -> None:
    source = SimulatedDrive(make_settings(seed=1))
    limits = {"K_max": 0.9 * PAPER_MOTOR["K"], "R_max": 0.95 * PAPER_MOTOR["R"], "B_max": 5.0, "Tc_max": 1.0}
    config = configuration(limits, nominal=dict(DEFAULT_NOMINAL))
    with caplog.at_level(logging.INFO):
        drive = DriveRuntime(config, Idle(source), None, lambda: None)
        assert [e.kind for e in drive.events()] == ["alarm_impossible"]
        drive.reader.queue.put(source.next_block(6000))
        drive.work()
    rung = {str(e.data["alarm"]): e for e in drive.events() if e.kind == "alarm"}
    assert set(rung) == {"K_max", "R_max"}
    assert rung["R_max"].data["value"] == pytest.approx(PAPER_MOTOR["R"], rel=0.05)
    told = [r for r in caplog.records if "its limit R_max" in r.getMessage()]
    assert len(told) == 1 and told[0].levelno == logging.WARNING
    assert documents.estimates_document(drive, drive.snapshot())["health"]["alarms"] == "K_max,R_max"
    assert documents.drive_document(drive)["limits"] == [
        {"name": name, "parameter": name[0], "value": limits[name], "is_upper": True}
        for name in ("K_max", "R_max", "B_max")
    ]

    drive.request_reset()
    drive.work()
    assert [e.kind for e in drive.events()][-3:] == ["reset", "alarm_cleared", "alarm_cleared"]
    drive.reader.queue.put(source.next_block(100))
    drive.work()
    assert documents.estimates_document(drive, drive.snapshot())["health"]["alarms"] is None


def test_metrics_show_both_sides_of_every_parameter() -> None:
    daemon = fake_daemon()
    assert "parameter_alarm" not in render_metrics(daemon), "not known, not shown"
    estimate = make_estimate(2.0, health={"alarms": "R_max,K_min"})
    daemon.drives["axis1"].publish(make_snapshot(t=2.0, estimate=estimate))
    lines = [x for x in render_metrics(daemon).splitlines() if x.startswith("servo_daemon_parameter_alarm{")]
    ringing = [x for x in lines if x.endswith(" 1")]
    assert len(lines) == 10 and len(ringing) == 2
    assert 'servo_daemon_parameter_alarm{drive="axis1",parameter="R",limit="max"} 1' in ringing
    daemon.drives["axis1"].publish(make_snapshot(t=3.0, estimate=make_estimate(3.0, health={"alarms": None})))
    lines = [x for x in render_metrics(daemon).splitlines() if x.startswith("servo_daemon_parameter_alarm{")]
    assert len(lines) == 10 and all(x.endswith(" 0") for x in lines)
