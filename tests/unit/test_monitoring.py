"""What Prometheus and Grafana are given: rules, dashboard and exposition fit together, by the tools' own checks."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.published.archive import Counts
from servo_daemon.published.diagnosis_state import Diagnosis, DiagnosisView
from servo_daemon.published.metrics import render_metrics
from servo_daemon.published.sinks import SinkState
from servo_daemon.published.trends import DriveTrends
from servo_daemon.trend.records import Limit, Range, Trend
from tests.fake_daemon import T0, fake_daemon, make_estimate, make_snapshot

_NAME = re.compile(r"\bservo_daemon_\w+")


class Kept:
    """An archive of which only the counts are asked."""

    counts = Counts()


@pytest.fixture(scope="module")
def exposition() -> str:
    """Of a daemon to which everything has happened."""
    daemon = fake_daemon()
    drive = daemon.drives["axis1"]
    daemon.archive = Kept()  # type: ignore[assignment]
    daemon.sinks = (SinkState("mqtt", True, 0, 10), SinkState("webhook_1", False, 3, 0, 1, 2, "away", None))
    margins = {"controller_margin_low": False, "controller_phase_margin_deg": 50.0, "controller_gain_margin_dB": 9.0}
    health = {"alarms": "R_max", "innovation_white": True, "filter_restarts": 1, **margins}
    drive.publish(make_snapshot(estimate=make_estimate(health=health)))
    counters = drive.snapshot().counters
    drive.current = replace(drive.snapshot(), counters={**counters, "crc_errors": 0, "framing_errors": 2})
    trend = Trend("trend", limit=Limit("R_max", 0.6, True), years=Range(1.0, 2.0, None), used=Range(0.4, 0.5, 0.6))
    drive.trends = DriveTrends(T0, None, 180.0, {"R": trend}, frozenset({"R"}))
    done = Diagnosis("done", result={"verdict": "found", "effects": [{"name": "coulomb_friction"}]})
    drive.diagnosis = DiagnosisView(done, drive.diagnosis.adoption, True, None, {"found": 1})
    return render_metrics(daemon)


@pytest.fixture(scope="module")
def dashboard(repo_root: Path) -> dict[str, Any]:
    text = (repo_root / "deploy" / "grafana" / "servo-daemon.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


@pytest.fixture(scope="module")
def promtool(program: Callable[..., str]) -> Callable[..., str]:
    path = program("promtool")

    def run(*words: str, stdin: str | None = None) -> str:
        done = subprocess.run([path, *words], input=stdin, text=True, capture_output=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    return run


def names_of(exposition: str) -> set[str]:
    return set(re.findall(r"^# TYPE (\S+)", exposition, re.MULTILINE))


def test_the_exposition_passes_promtool(exposition: str, promtool: Callable[..., str]) -> None:
    assert promtool("check", "metrics", stdin=exposition) == ""


def test_the_rules_hold_and_use_only_what_there_is(
    exposition: str, repo_root: Path, promtool: Callable[..., str]
) -> None:
    folder = repo_root / "deploy" / "prometheus"
    assert "SUCCESS" in promtool("check", "rules", str(folder / "servo-daemon.rules.yml"))
    assert "SUCCESS" in promtool("test", "rules", str(folder / "servo-daemon.test.yml"))
    text = (folder / "servo-daemon.rules.yml").read_text(encoding="utf-8")
    used = {name for line in re.findall(r"expr: (.*)", text) for name in _NAME.findall(line)}
    assert len(used) > 15
    assert used - names_of(exposition) == set()


def test_the_documented_expressions_are_the_rules(repo_root: Path, exposition: str) -> None:
    text = (repo_root / "docs" / "operations.md").read_text(encoding="utf-8")
    assert set(_NAME.findall(text)) - names_of(exposition) == set()


def panels_of(dashboard: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for panel in dashboard["panels"]:
        yield panel
        yield from panel.get("panels", [])


def expressions(dashboard: dict[str, Any]) -> list[str]:
    return [target["expr"] for panel in panels_of(dashboard) for target in panel.get("targets", [])]


def test_the_dashboard_uses_only_what_there_is(dashboard: dict[str, Any], exposition: str) -> None:
    queries = [v["definition"] for v in dashboard["templating"]["list"] if v["type"] == "query"]
    used = {name for text in (*expressions(dashboard), *queries) for name in _NAME.findall(text)}
    assert len(used) > 25
    assert used - names_of(exposition) == set()


def test_the_dashboard_s_expressions_are_promql(
    dashboard: dict[str, Any], tmp_path: Path, promtool: Callable[..., str]
) -> None:
    rules = []
    for number, text in enumerate(expressions(dashboard)):
        expression = text.replace("$__rate_interval", "5m").replace("$instance", ".+").replace("$drive", ".+")
        rules.append({"record": f"panel:{number}", "expr": expression})
    file = tmp_path / "panels.yml"  # JSON is YAML
    file.write_text(json.dumps({"groups": [{"name": "panels", "rules": rules}]}), encoding="utf-8")
    assert f"{len(rules)} rules found" in promtool("check", "rules", str(file))


def test_the_dashboard_is_one(dashboard: dict[str, Any]) -> None:
    """What Grafana wants of the JSON model: ids, places on the grid of 24 columns, targets, variables."""
    assert {"title", "uid", "schemaVersion", "panels", "templating", "time"} <= dashboard.keys()
    panels = list(panels_of(dashboard))
    assert len({p["id"] for p in panels}) == len(panels)
    names = {v["name"] for v in dashboard["templating"]["list"]}
    assert set(re.findall(r"\$\{?(\w+)", json.dumps(dashboard))) - {"__rate_interval", "__all"} <= names
    for panel in panels:
        place = panel["gridPos"]
        assert place["x"] >= 0 and place["w"] > 0 and place["x"] + place["w"] <= 24
        if panel["type"] == "row":
            continue
        assert panel["datasource"] == {"type": "prometheus", "uid": "${datasource}"}
        assert panel["fieldConfig"].keys() == {"defaults", "overrides"}
        ids = [target["refId"] for target in panel["targets"]]
        assert ids and len(set(ids)) == len(ids)
    rows = {p["title"]: p.get("repeat") for p in panels if p["type"] == "row"}
    assert rows == {"Fleet": None, "Drive $drive": "drive"}
    for one, other in combinations([p["gridPos"] for p in panels], 2):
        apart = (
            one["x"] + one["w"] <= other["x"]
            or other["x"] + other["w"] <= one["x"]
            or one["y"] + one["h"] <= other["y"]
            or other["y"] + other["h"] <= one["y"]
        )
        assert apart, (one, other)
