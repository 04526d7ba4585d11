"""The running program with a real broker, a web server and Prometheus' own tool."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.mosquitto import HOST, Broker, Listener
from tests.system.harness import ROOT, STOP_S, all_tracking, daemon, nominal_table, wait_for, write_config
from tests.unit.webhooks.test_webhooks import Receiver

pytestmark = [pytest.mark.slow, pytest.mark.system]

STATUS, STATE, EVENT = (f"servo-daemon/n1/{topic}" for topic in ("status", "axis1/state", "axis1/event"))
#: Metrics that a daemon has only after months, or after a diagnosis.
_LATER = {"servo_daemon_life_used_ratio", "servo_daemon_limit_near", "servo_daemon_diagnosis_found"}


@pytest.fixture
def broker(program: Callable[..., str], tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(program("mosquitto", "/usr/sbin/mosquitto"), tmp_path)
    broker.start()
    yield broker
    broker.kill()


def test_estimates_events_and_metrics_reach_other_systems(
    broker: Broker, program: Callable[..., str], tmp_path: Path
) -> None:
    receiver = Receiver()
    head = f"""
[storage]
state_dir = "{tmp_path}/state"
[mqtt]
host = "{HOST}"
port = {broker.port}
node = "n1"
home_assistant = true
interval_s = 0.2
[[webhook]]
url = "{receiver.url}"
kinds = ["connected", "filter_started"]
"""
    tables = f"{nominal_table()}[drive.controller]\nspeed_kp_V_s_rad = 1.5\nspeed_ki_V_rad = 30.0\nrate_hz = 1000\n"
    config = write_config(tmp_path / "c.toml", f'name = "axis1"\nmodel = []\n{tables}', head=head)
    with Listener(broker.port) as ear, daemon("--config", config) as servo:
        servo.until(all_tracking, "everything is known")
        wait_for(lambda: all_known(ear.of(STATE)[-1]), "everything is told")
        published, asked = json.loads(ear.of(STATE)[-1])["parameters"], servo.estimates()["parameters"]
        for name, p in published.items():
            assert p["unit"] == asked[name]["unit"]
            assert abs(p["value"] - asked[name]["value"]) < 10.0 * asked[name]["std"]  # moments apart
        watched = "\nservo_daemon_controller_margin_low"
        wait_for(lambda: watched in servo.client.get("/metrics").text, "the margins are watched")
        exposition = servo.client.get("/metrics").text
        assert 'servo_daemon_sink_connected{sink="mqtt"} 1' in exposition

        broker.kill()
        wait_for(lambda: servo.get("/health")["sinks"]["mqtt"]["waiting"] > 5, "states are kept")
        assert (servo.get("/health")["status"], servo.get("/health")["sinks"]["mqtt"]["connected"]) == ("ok", False)
        ear.forget()
        broker.start()
        wait_for(lambda: servo.get("/health")["sinks"]["mqtt"]["waiting"] == 0, "what was kept is sent")
        assert servo.get("/health")["sinks"]["mqtt"]["dropped"] == 0
        ear.resubscribed()
        ear.wait(STATE)
        assert servo.stop() < STOP_S
        wait_for(lambda: ear.of(STATUS)[-1:] == [b"offline"], "it is told to be offline")
    assert [json.loads(body)["kind"] for _, body in receiver.requests] == ["connected", "filter_started"]
    receiver.close()
    check_metrics(program("promtool"), exposition)


def all_known(state: bytes) -> bool:
    return all(p["value"] is not None for p in json.loads(state)["parameters"].values())


def check_metrics(promtool: str, exposition: str) -> None:
    """It passes promtool, and rules and dashboard speak of nothing else."""
    checked = subprocess.run(
        [promtool, "check", "metrics"], input=exposition, text=True, capture_output=True, check=False
    )
    assert (checked.returncode, checked.stdout + checked.stderr) == (0, "")
    names = set(re.findall(r"^# TYPE (\S+)", exposition, re.MULTILINE))
    for file in ("prometheus/servo-daemon.rules.yml", "grafana/servo-daemon.json"):
        text = (ROOT / "deploy" / file).read_text(encoding="utf-8")
        assert set(re.findall(r"\bservo_daemon_\w+", text)) - names - _LATER == set(), file
