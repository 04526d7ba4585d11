"""JSON topics and Home Assistant's discovery against a real broker."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jinja2
import paho.mqtt.client as mqtt
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from servo_daemon.published.snapshot import AlarmLimit
from tests.fake_daemon import make_estimate, make_snapshot, parameters_at
from tests.mosquitto import HOST, Broker, Listener, wait_for
from tests.unit.mqtt.conftest import Gate
from tests.unit.mqtt.rig import Drive, publishing

STATUS, STATE, EVENT = "servo-daemon/n1/status", "servo-daemon/n1/axis1/state", "servo-daemon/n1/axis1/event"
HISTORY = "servo-daemon/n1/axis1/history"
DISCOVERY = "homeassistant/device/servo-daemon_n1_axis1/config"


@pytest.fixture(autouse=True)
def nothing_retained(broker: Broker) -> Iterator[None]:
    yield
    cleaner = mqtt.Client(CallbackAPIVersion.VERSION2)
    cleaner.connect(HOST, broker.port)
    gone = [cleaner.publish(topic, b"", retain=True) for topic in (STATUS, STATE, DISCOVERY)]
    wait_for(lambda: cleaner.loop(0.01) or all(info.is_published() for info in gone), "retained messages are deleted")
    cleaner.disconnect()


def value(state: bytes, parameter: str) -> Any:
    return json.loads(state)["parameters"][parameter]["value"]


def test_state_events_and_availability(broker: Broker) -> None:
    drive = Drive()
    with Listener(broker.port) as ear, publishing(broker, [drive]):
        ear.wait(STATUS)
        assert value(ear.wait(STATE)[-1], "R") == drive.snapshot().estimate.parameters[0].value  # type: ignore[union-attr]
        drive.log.add("parameter_jump", "R stepped", {"parameter": "R", "from": 0.5, "to": 0.6})
        (event,) = ear.wait(EVENT)
        assert json.loads(event)["kind"] == "parameter_jump"
        assert json.loads(event)["data"] == {"parameter": "R", "from": 0.5, "to": 0.6}
        with Listener(broker.port) as late:  # sees what is retained
            late.wait(STATE)
            late.wait(STATUS)
            assert [retained for _, _, retained in late.heard] == [True, True]
    assert ear.of(STATUS) == [b"online", b"offline"]


def test_no_value_that_is_not_known_now(broker: Broker) -> None:
    held = (*parameters_at(1.0)[:1], *parameters_at(1.0, "unexcited")[1:3], *parameters_at(1.0, "estimating")[3:])
    drive = Drive()
    drive.publish(make_snapshot(estimate=make_estimate(parameters=held, state={"temperature_C": 41.0})))
    with Listener(broker.port) as ear, publishing(broker, [drive]):
        state = json.loads(ear.wait(STATE)[-1])
        known = {name for name, p in state["parameters"].items() if p["value"] is not None or p["std"] is not None}
        assert (known, state["parameters"]["L"]["status"], state["state"]) == (
            {"R"},
            "unexcited",
            {"temperature_C": 41.0},
        )
        drive.lose("silent", "no samples")
        wait_for(lambda: json.loads(ear.of(STATE)[-1])["connection"] == "silent", "the drive is told to be silent")
        state = json.loads(ear.of(STATE)[-1])
        assert {p["value"] for p in state["parameters"].values()} == {None}
        assert state["state"] == {"temperature_C": None}


def test_the_last_will_tells_of_a_lost_connection(broker: Broker) -> None:
    with Listener(broker.port, STATUS) as ear, publishing(broker, [Drive()]) as sink:
        ear.wait(STATUS)
        ear.forget()
        robber = mqtt.Client(CallbackAPIVersion.VERSION2, "servo-daemon-n1")  # the broker cuts off who had this name
        robber.connect(HOST, broker.port)
        robber.loop(0.1)
        assert ear.wait(STATUS)[0] == b"offline"
        robber.disconnect()
        robber.loop(0.1)
        wait_for(lambda: ear.of(STATUS)[-1] == b"online", "connected again")
        wait_for(lambda: sink.state.reconnects >= 1, "the reconnection is counted")  # after the broker has told it


def test_home_assistant_is_told_of_every_entity(broker: Broker) -> None:
    limits = (AlarmLimit("R_max", "R", True, 0.6), AlarmLimit("K_min", "K", False, 0.2))
    drive = Drive(limits=limits)
    some = (*parameters_at(1.0)[:4], *parameters_at(1.0, "unexcited")[4:])
    health = {"alarms": "R_max", "controller_margin_low": False}
    drive.publish(make_snapshot(estimate=make_estimate(parameters=some, health=health, state={"temperature_C": 41.5})))
    with Listener(broker.port) as ear, publishing(broker, [drive], home_assistant=True):
        document = json.loads(ear.wait(DISCOVERY)[-1])
        shown = entities(document, ear.wait(STATE)[-1])
        assert [t for t, _, _ in ear.heard].index(DISCOVERY) < [t for t, _, _ in ear.heard].index(STATE)
    assert (document["state_topic"], document["availability"]) == (STATE, [{"topic": STATUS}])
    assert document["device"]["identifiers"] == ["servo-daemon_n1_axis1"]
    parameters = {name: shown[name] for name in "RLKJB"}
    assert parameters == {p.name: str(p.value) for p in some} | {"B": "None"}  # which Home Assistant shows as unknown
    assert {k: v for k, v in shown.items() if k.startswith("alarm")} == {
        "alarm": "ON", "alarm_R_max": "ON", "alarm_K_min": "OFF", "alarm_controller_margin": "OFF",
    }  # fmt: skip
    assert (shown["connection"], shown["temperature_C"]) == ("connected", "41.5")
    components = document["components"]
    assert len({c["unique_id"] for c in components.values()}) == len(components)
    assert (components["K"]["unit_of_measurement"], components["K"]["state_class"]) == ("N·m/A", "measurement")
    assert components["K"]["name"] == "Torque constant K"
    temperature = components["temperature_C"]
    assert (temperature["device_class"], temperature["unit_of_measurement"]) == ("temperature", "°C")
    assert all({"platform", "unique_id", "value_template"} <= c.keys() for c in components.values())


def entities(document: dict[str, Any], state: bytes) -> dict[str, str]:
    """What Home Assistant makes of a state: every template rendered as it renders them."""
    render = jinja2.Environment().from_string
    found = json.loads(state)
    return {k: render(c["value_template"]).render(value_json=found) for k, c in document["components"].items()}


def test_what_the_model_no_longer_has_is_taken_away(broker: Broker) -> None:
    drive = Drive()
    more = (*parameters_at(1.0), replace(parameters_at(1.0)[0], name="Tc", unit="N·m"))
    drive.publish(make_snapshot(estimate=make_estimate(parameters=more)))
    with Listener(broker.port, DISCOVERY) as ear:
        with publishing(broker, [drive], home_assistant=True):
            wait_for(lambda: ear.heard and "Tc" in json.loads(ear.heard[-1][1])["components"], "Tc is there")
        ear.forget()
        drive.publish(make_snapshot())
        with publishing(broker, [drive], home_assistant=True):  # a later run, which knows nothing of the first
            wait_for(lambda: len(ear.heard) >= 3, "the broker's message is answered")
        told = [json.loads(payload)["components"].get("Tc") for _, payload, _ in ear.heard]
    assert told[-2:] == [{"platform": "sensor"}, None]  # taken away, then no longer mentioned


def test_nothing_is_lost_while_the_broker_is_away(broker: Broker, gate: Gate, tmp_path: Path) -> None:
    drive = Drive()
    with Listener(broker.port) as ear, publishing(broker, [drive], tmp_path) as sink:
        ear.wait(STATE)
        broker.kill()
        ear.forget()
        wait_for(lambda: not sink.state.connected, "the loss is seen")
        times = [1000.0 + k for k in range(8)]
        for k, t in enumerate(times):
            drive.publish(make_snapshot(t=t))
            drive.log.add("alarm", f"event {k}")
            wait_for(lambda k=k: sink.state.waiting >= 2 * k + 1, "it is kept")  # type: ignore[misc]
        assert (tmp_path / "mqtt.sqlite").exists()
        gate.shut()
        broker.start()
        ear.resubscribed()
        gate.open()
        wait_for(lambda: sink.state.connected and not sink.state.waiting, "all is sent")
        ear.wait(EVENT, len(times))
        states = [*ear.wait(HISTORY, len(times) - 1), ear.of(STATE)[0]]  # the newest is the present
        assert sink.state.dropped == 0
    assert [json.loads(event)["message"] for event in ear.of(EVENT)] == [f"event {k}" for k in range(8)]
    assert [value(state, "R") for state in states][-8:] == [parameters_at(t)[0].value for t in times]
    assert ear.of(STATUS) == [b"online", b"offline"]


def test_what_waits_survives_a_restart_of_the_daemon(broker: Broker, tmp_path: Path) -> None:
    drive = Drive()
    broker.kill()
    with publishing(broker, [drive], tmp_path) as sink:
        drive.log.add("alarm", "kept")
        wait_for(lambda: sink.state.waiting and sink.state.reason, "it is kept")
    broker.start()
    with Listener(broker.port) as ear, publishing(broker, [Drive()], tmp_path):
        assert json.loads(ear.wait(EVENT)[0])["message"] == "kept"
        assert value(ear.wait(HISTORY)[0], "R") == drive.snapshot().estimate.parameters[0].value  # type: ignore[union-attr]


def test_drives_come_and_go_with_the_configuration(broker: Broker) -> None:
    one, two, again = Drive(), Drive("axis2"), Drive()
    with Listener(broker.port) as ear, publishing(broker, [one], home_assistant=True) as sink:
        ear.wait(STATE)
        one.log.add("alarm", "the last of the first")
        again.publish(make_snapshot(t=9.0))
        again.log.add("reloaded", "in the place of the first")
        sink.follow([again, two])
        ear.wait("servo-daemon/n1/axis2/state")
        assert [json.loads(e)["message"] for e in ear.wait(EVENT, 2)] == [
            "the last of the first", "in the place of the first",
        ]  # fmt: skip
        wait_for(lambda: value(ear.of(STATE)[-1], "R") == parameters_at(9.0)[0].value, "the new one's state")
        sink.follow([again])
        gone = [DISCOVERY.replace("axis1", "axis2"), "servo-daemon/n1/axis2/state"]
        wait_for(lambda: all(ear.of(topic)[-1] == b"" for topic in gone), "what is retained of it is deleted")
    assert sink.state.dropped == 0


def test_beyond_the_buffer_the_oldest_go_and_are_counted(broker: Broker, gate: Gate) -> None:
    drive = Drive()
    broker.kill()
    with publishing(broker, [drive], buffer_MB=0.1) as sink:
        for number in range(4):
            drive.log.add("alarm", f"{number}", {"detail": "x" * 40_000})
        wait_for(lambda: sink.state.dropped == 2, "two do not fit")
        gate.shut()
        broker.start()
        with Listener(broker.port, EVENT) as ear:
            gate.open()
            events = ear.wait(EVENT, 2)
            wait_for(lambda: not sink.state.waiting, "all is sent")
    assert [json.loads(event)["message"] for event in events] == ["2", "3"]
    assert sink.state.dropped == 2


# paho leaves the socket of a failed handshake to the garbage collector.
@pytest.mark.filterwarnings("ignore:unclosed <ssl:ResourceWarning")
def test_password_and_tls(program: Callable[..., str], tmp_path: Path) -> None:
    openssl, passwd = program("openssl"), program("mosquitto_passwd")
    make_certificates(openssl, tmp_path)
    run(passwd, "-b", "-c", str(tmp_path / "users"), "servo", "right")
    (tmp_path / "password").write_text("right\n")
    (tmp_path / "wrong").write_text("wrong\n")
    lines = ["allow_anonymous false", f"password_file {tmp_path}/users", f"cafile {tmp_path}/ca.pem"]
    broker = Broker(
        program("mosquitto", "/usr/sbin/mosquitto"), tmp_path, *lines, f"certfile {tmp_path}/server.pem",
        f"keyfile {tmp_path}/server.key", "require_certificate true",
    )  # fmt: skip
    certificate = {"certificate": f"{tmp_path}/client.pem", "private_key": f"{tmp_path}/client.key"}
    keys: dict[str, object] = {"tls": True, "ca_file": f"{tmp_path}/ca.pem", "username": "servo", **certificate}

    def prepare(client: mqtt.Client) -> None:
        client.username_pw_set("servo", "right")
        client.tls_set(f"{tmp_path}/ca.pem", f"{tmp_path}/client.pem", f"{tmp_path}/client.key")

    broker.start()
    try:
        with Listener(broker.port, prepare=prepare) as ear:
            with publishing(broker, [Drive()], **keys, password_file=f"{tmp_path}/password") as sink:
                assert value(ear.wait(STATE)[0], "R")
            with publishing(broker, [Drive()], **keys, password_file=f"{tmp_path}/wrong") as sink:
                wait_for(lambda: "Not authorized" in str(sink.state.reason), "the refusal is told")
                assert sink.state.connected is False
            with publishing(broker, [Drive()], **{**keys, "ca_file": None, "username": None}) as sink:
                wait_for(lambda: "certificate verify failed" in str(sink.state.reason), "a stranger is not trusted")
    finally:
        broker.kill()


def run(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True)


def make_certificates(openssl: str, folder: Path) -> None:
    """A CA, and a server's and a client's certificate of it."""
    new = ["req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    run(
        openssl,
        *new,
        "-x509",
        "-days",
        "2",
        "-subj",
        "/CN=ca",
        "-keyout",
        f"{folder}/ca.key",
        "-out",
        f"{folder}/ca.pem",
    )
    (folder / "names").write_text(f"subjectAltName=IP:{HOST}\n")
    for name in ("server", "client"):
        at = f"{folder}/{name}"
        run(openssl, *new, "-subj", f"/CN={name}", "-keyout", f"{at}.key", "-out", f"{at}.csr")
        run(
            openssl, "x509", "-req", "-in", f"{at}.csr", "-CA", f"{folder}/ca.pem", "-CAkey", f"{folder}/ca.key",
            "-CAcreateserial", "-days", "2", "-extfile", f"{folder}/names", "-out", f"{at}.pem",
        )  # fmt: skip
