"""The metrics, read by a parser as strict as Prometheus' own and by the rules of `promtool check metrics`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from servo_daemon.api.app import create_app
from servo_daemon.published.exposition import Exposition, unit_words
from servo_daemon.published.metrics import render_metrics
from servo_daemon.published.snapshot import ParameterEstimate
from tests.fake_daemon import FakeDaemon, fake_daemon, make_estimate, make_snapshot
from tests.http_rig import Client
from tests.unit.history.world import World

_LABEL = re.compile(r'([a-zA-Z_][a-zA-Z0-9_]*)="((?:[^"\\\n]|\\["\\n])*)"(,|$)')
_SAMPLE = re.compile(r"([a-zA-Z_:][a-zA-Z0-9_:]*)(?:\{(.*)\})? (\S+)")
_ESCAPES = {"\\\\": "\\", "\\n": "\n", '\\"': '"'}


@dataclass
class Family:
    kind: str
    help: str
    samples: dict[tuple[tuple[str, str], ...], float]


def unescape(text: str) -> str:
    return re.sub(r'\\[\\n"]', lambda m: _ESCAPES[m[0]], text)


def parse_labels(text: str) -> tuple[tuple[str, str], ...]:
    labels: dict[str, str] = {}
    position = 0
    while position < len(text):
        match = _LABEL.match(text, position)
        assert match, f"labels {text!r} at {position}"
        assert match[1] not in labels
        labels[match[1]] = unescape(match[2])
        position = match.end()
    return tuple(sorted(labels.items()))


def parse(text: str) -> dict[str, Family]:
    """Families by name; asserts everything the format demands."""
    assert text.endswith("\n")
    assert "\r" not in text
    families: dict[str, Family] = {}
    name = ""
    for line in text[:-1].split("\n"):
        if line.startswith("# HELP "):
            name, _, words = line.removeprefix("# HELP ").partition(" ")
            assert name not in families, f"{name} comes twice"
            families[name] = Family("", words, {})
        elif line.startswith("# TYPE "):
            typed, kind = line.removeprefix("# TYPE ").split(" ")
            assert typed == name, "TYPE follows its HELP"
            assert not families[name].samples
            assert kind in {"gauge", "counter"}
            families[name].kind = kind
        else:
            match = _SAMPLE.fullmatch(line)
            assert match, line
            assert match[1] == name, f"{match[1]} among the samples of {name}"
            labels = parse_labels(match[2] or "")
            assert labels not in families[name].samples, f"{line} comes twice"
            families[name].samples[labels] = float(match[3])
    return families


def check_rules(families: dict[str, Family]) -> None:
    """promtool's rules, and ours: every value finite."""
    for name, family in families.items():
        assert family.kind, name
        assert family.help, name
        assert family.samples, name
        assert name.startswith("servo_daemon_")
        assert (family.kind == "counter") == name.endswith("_total"), name
        assert not re.search(r"_(ms|us|s|hz|A|V|rad|milliseconds|microseconds)$", name), f"{name}: not a base unit"
        assert all(math.isfinite(v) for v in family.samples.values())


def metrics(daemon: FakeDaemon) -> dict[str, Family]:
    families = parse(render_metrics(daemon))
    check_rules(families)
    return families


def test_the_numbers_of_a_drive() -> None:
    daemon = fake_daemon()
    families = metrics(daemon)
    drive = (("drive", "axis1"),)
    estimate = daemon.drives["axis1"].snapshot().estimate
    assert estimate is not None
    shown = {p.name: p for p in estimate.parameters}
    for symbol, words, unit in (
        ("R", "resistance", "ohm"),
        ("L", "inductance", "henry"),
        ("K", "torque_constant", "newton_meter_per_ampere"),
        ("J", "inertia", "kilogram_square_meter"),
        ("B", "viscous_friction", "newton_meter_second_per_radian"),
    ):
        assert families[f"servo_daemon_{words}_{unit}"].samples == {drive: shown[symbol].value}
        assert families[f"servo_daemon_{words}_std_{unit}"].samples == {drive: shown[symbol].std}
        assert families[f"servo_daemon_{words}_nominal_{unit}"].samples == {drive: shown[symbol].nominal}
    assert families["servo_daemon_samples_total"] == Family(
        "counter", "Samples received from the drive.", {drive: 1000}
    )
    assert families["servo_daemon_samples_lost_total"].samples == {drive: 0}
    assert families["servo_daemon_queue_samples"].kind == "gauge"
    assert families["servo_daemon_sample_rate_hertz"].samples == {drive: 1000.2}
    assert families["servo_daemon_innovation_white"].samples == {drive: 1}
    assert families["servo_daemon_step_time_seconds"].samples[drive] == pytest.approx(8.5e-6)
    assert families["servo_daemon_current_ampere"].samples == {drive: estimate.state["current_A"]}
    assert families["servo_daemon_velocity_radian_per_second"].samples == {drive: estimate.state["velocity_rad_s"]}
    assert families["servo_daemon_position_radian"].samples == {drive: estimate.state["position_rad"]}
    truth = (("drive", "axis1"), ("parameter", "R"))
    assert families["servo_daemon_simulated_truth"].samples[truth] == 0.4937


def test_exactly_one_state_and_one_status_is_true() -> None:
    daemon = fake_daemon("a", "b")
    daemon.drives["a"].lose("down", "unplugged")
    families = metrics(daemon)
    states = families["servo_daemon_connection_state"].samples
    assert {dict(k)["state"] for k, v in states.items() if v == 1 and dict(k)["drive"] == "a"} == {"down"}
    assert {dict(k)["state"] for k, v in states.items() if v == 1 and dict(k)["drive"] == "b"} == {"connected"}
    assert len(states) == 2 * 5
    statuses = families["servo_daemon_parameter_status"].samples
    assert len(statuses) == 2 * 5 * 6
    true = {(dict(k)["drive"], dict(k)["parameter"]): dict(k)["status"] for k, v in statuses.items() if v == 1}
    assert true[("a", "R")] == "invalid"
    assert true[("b", "R")] == "tracking"
    assert len(true) == 10


def test_before_the_first_samples_unknown_numbers_are_absent() -> None:
    families = metrics(fake_daemon(published=False))
    assert "servo_daemon_last_sample_time_seconds" not in families
    assert "servo_daemon_resistance_ohm" not in families
    assert families["servo_daemon_drive_info"].samples == {(("drive", "axis1"), ("driver", "simulated")): 1}


def test_what_is_not_a_number_is_absent() -> None:
    daemon = fake_daemon()
    parameters = (
        ParameterEstimate("R", math.nan, math.inf, "Ω", None, "invalid"),
        ParameterEstimate("mu", 0.1, None, "", None, "tracking"),
        ParameterEstimate("R_th", 2.0, 0.5, "K/W", None, "tracking"),
        ParameterEstimate("I-sat", 3.0, 0.5, "A", None, "tracking"),
    )
    health = {"text": "words", "unknown": None, "nis": math.nan, "fine": 2}
    estimate = make_estimate(2.0, parameters, state={"theta": 1.0, "current_A": None}, health=health)
    daemon.drives["axis1"].publish(make_snapshot(t=2.0, estimate=estimate))
    families = metrics(daemon)
    assert not {n for n in families if "resistance_ohm" in n or n.endswith(("_text", "_unknown", "_nis"))}
    drive = (("drive", "axis1"),)
    assert families["servo_daemon_mu"].samples == {drive: 0.1}
    assert families["servo_daemon_R_th_kelvin_per_watt"].samples == {drive: 2.0}
    assert families["servo_daemon_I_sat_std_ampere"].samples == {drive: 0.5}
    assert families["servo_daemon_theta"].samples == {drive: 1.0}
    assert families["servo_daemon_fine"].samples == {drive: 2}


def test_labels_survive_any_text() -> None:
    daemon = fake_daemon()
    drive = daemon.drives["axis1"]
    nasty = 'a"b\\c\nd{e}=f,'
    drive.driver = nasty
    drive.publish(replace(make_snapshot(t=2.0), driver=nasty))
    families = metrics(daemon)
    assert families["servo_daemon_drive_info"].samples == {(("drive", "axis1"), ("driver", nasty)): 1}


def test_the_route() -> None:
    response = Client(create_app(fake_daemon())).get("/metrics")
    assert response.status_code == 200
    assert response.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    families = parse(response.text)
    assert families["servo_daemon_build_info"].samples == {(("version", "1.2.3"),): 1}
    assert families["servo_daemon_healthy"].samples == {(): 1}


def test_a_daemon_with_a_problem() -> None:
    daemon = fake_daemon()
    daemon.wrong = ("it does not turn",)
    assert metrics(daemon)["servo_daemon_healthy"].samples == {(): 0}


def test_what_the_history_lost_is_counted(tmp_path: Path) -> None:
    daemon = fake_daemon()
    assert "history" not in render_metrics(daemon)
    world = World.in_folder(tmp_path)
    world.run(3.0)
    daemon.archive = world.archive
    text = render_metrics(daemon)
    assert "servo_daemon_history_rows_total 30\n" in text and "servo_daemon_history_rows_dropped_total 0\n" in text
    world.recorder.close()


def test_impossible_metrics_are_refused() -> None:
    out = Exposition()
    with pytest.raises(ValueError, match="not a metric name"):
        out.add("1 bad name", "gauge", "Bad.", 1)
    out.add("good", "gauge", "Good.", 1)
    with pytest.raises(ValueError, match="is a gauge"):
        out.add("good", "counter", "Good.", 1)


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        ("", ""),
        (None, ""),
        ("1", ""),
        ("Ω", "ohm"),
        ("N·m·s/rad", "newton_meter_second_per_radian"),
        ("kg·m²", "kilogram_square_meter"),
        ("1/s", "per_second"),
        ("rad/s²", "radian_per_square_second"),
        ("°C", "celsius"),
        ("furlong/fortnight", "furlong_per_fortnight"),
    ],
)
def test_units_as_words(unit: str | None, words: str) -> None:
    assert unit_words(unit) == words
