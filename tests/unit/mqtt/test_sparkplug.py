"""Sparkplug B against a real broker, its payloads read from their bytes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from servo_daemon.disk_queue import Item
from servo_daemon.mqtt.report import report_of
from servo_daemon.mqtt.sparkplug import Sparkplug
from servo_daemon.published.snapshot import AlarmLimit
from tests.fake_daemon import T0, make_estimate, make_snapshot, parameters_at
from tests.mosquitto import Broker, Listener, wait_for
from tests.unit.mqtt.conftest import Gate
from tests.unit.mqtt.protobuf_wire import read
from tests.unit.mqtt.rig import Drive, publishing

BASE = "spBv1.0/servo-daemon"
NBIRTH, NDEATH, NDATA = (f"{BASE}/{kind}/n1" for kind in ("NBIRTH", "NDEATH", "NDATA"))
DBIRTH, DDEATH, DDATA = (f"{BASE}/{kind}/n1/axis1" for kind in ("DBIRTH", "DDEATH", "DDATA"))
NCMD = f"{BASE}/NCMD/n1"
#: A payload with one metric, "Node Control/Rebirth" = true, as its bytes: field 2 (metric) holds 1 (name), 4 (datatype
#: Boolean) and 14 (boolean value).
REBIRTH = bytes([0x12, 26, 0x0A, 20]) + b"Node Control/Rebirth" + bytes([0x20, 11, 0x70, 1])


def by_name(payload: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {metric["name"]: metric for metric in payload["metrics"]}


def kinds(ear: Listener) -> list[str]:
    return [topic.split("/")[2] for topic, _, _ in list(ear.heard) if topic.startswith(BASE)]


def test_births_data_by_alias_and_deaths(broker: Broker) -> None:
    drive = Drive(limits=(AlarmLimit("R_max", "R", True, 0.6),))
    known = (*parameters_at(1.0)[:4], *parameters_at(1.0, "unexcited")[4:])
    estimate = make_estimate(parameters=known, health={"alarms": None})
    drive.publish(make_snapshot(estimate=estimate))
    with Listener(broker.port) as ear:
        with publishing(broker, [drive], encoding="sparkplug"):
            (node,), (device,) = (list(map(read, ear.wait(topic))) for topic in (NBIRTH, DBIRTH))
            assert (node["seq"], device["seq"]) == (0, 1)
            metrics = by_name(node)
            assert (metrics["bdSeq"]["value"], metrics["bdSeq"]["datatype"]) == (0, 8)
            rebirth = metrics["Node Control/Rebirth"]
            assert (rebirth["value"], rebirth["datatype"], "alias" in rebirth) == (0, 11, False)
            born = by_name(device)
            R, B = born["parameters/R/value"], born["parameters/B/value"]
            assert (R["value"], R["datatype"], R["properties"]) == (known[0].value, 10, {"engUnit": "Ω"})
            assert (B["is_null"], "value" in B, born["parameters/B/status"]["value"]) == (1, False, "unexcited")
            assert (born["alarms/R_max"]["value"], born["connection"]["value"]) == (0, "connected")
            assert R["timestamp"] == round((T0 + 1.0) * 1e3)
            aliases = [m["alias"] for p in (node, device) for m in p["metrics"] if "alias" in m]
            assert len(set(aliases)) == len(aliases) == len(device["metrics"]) + 1

            rings = make_estimate(parameters=known, health={"alarms": "R_max"})
            drive.publish(make_snapshot(estimate=rings))
            data = read(ear.wait(DDATA)[0])
            assert [(m["alias"], m["value"], "name" in m) for m in data["metrics"]] == [
                (born["alarms/R_max"]["alias"], 1, False)
            ]
            drive.log.add("alarm", "R is high")
            event = read(ear.wait(NDATA)[0])["metrics"][0]
            assert (event["alias"], json.loads(event["value"])["message"]) == (metrics["event"]["alias"], "R is high")
            drive.lose("down", "unplugged")
            ear.wait(DDEATH)
            drive.publish(make_snapshot())
            ear.wait(DBIRTH, 2)
        ear.wait(NDEATH)  # it is on its way when the sink has ended
    assert kinds(ear)[-2:] == ["DDEATH", "NDEATH"]
    death = read(ear.of(NDEATH)[-1])
    assert ("seq" in death, by_name(death).keys(), by_name(death)["bdSeq"]["value"]) == (False, {"bdSeq"}, 0)
    sequence = [read(payload)["seq"] for topic, payload, _ in ear.heard if "NDEATH" not in topic]
    assert sequence == list(range(len(sequence)))
    assert not any(retained for _, _, retained in ear.heard)


def test_rebirth_on_command(broker: Broker) -> None:
    drive = Drive()
    with Listener(broker.port) as ear, publishing(broker, [drive], encoding="sparkplug"):
        ear.wait(DBIRTH)
        ear.client.publish(NCMD, REBIRTH)
        node, device = read(ear.wait(NBIRTH, 2)[1]), read(ear.wait(DBIRTH, 2)[1])
        assert (node["seq"], device["seq"], by_name(node)["bdSeq"]["value"]) == (0, 1, 0)
        ear.client.publish(NCMD, b"\x99garbage")
        drive.publish(make_snapshot(t=2.0))
        assert read(ear.wait(DDATA)[-1])["seq"] == 2
        assert len(ear.of(NBIRTH)) == 2


def test_the_time_without_a_broker_comes_as_history(broker: Broker, gate: Gate, tmp_path: Path) -> None:
    drive = Drive()
    with Listener(broker.port) as ear, publishing(broker, [drive], tmp_path, encoding="sparkplug") as sink:
        alias = by_name(read(ear.wait(DBIRTH)[0]))["parameters/R/value"]["alias"]
        broker.kill()
        ear.forget()
        wait_for(lambda: not sink.state.connected, "the loss is seen")
        for k, t in enumerate((1000.0, 1001.0, 1002.0)):
            drive.publish(make_snapshot(t=t))
            drive.log.add("alarm", "taken up together with the state")
            wait_for(lambda k=k: sink.state.waiting >= 2 * k + 1, "it is kept")  # type: ignore[misc]
        gate.shut()
        broker.start()
        ear.resubscribed()
        gate.open()
        wait_for(lambda: sink.state.connected and not sink.state.waiting, "all is sent")
        drive.lose("down", "unplugged")
        ear.wait(DDEATH)
        told = [read(payload) for payload in ear.of(DDATA)]
        births = [by_name(read(payload)) for payload in ear.of(DBIRTH)]
    of_R = [m for p in told for m in p["metrics"] if m["alias"] == alias and "is_historical" in m]
    past = {m["timestamp"]: m["value"] for m in of_R}
    expected = {round((T0 + t) * 1e3): parameters_at(t)[0].value for t in (1000.0, 1001.0)}
    assert {t: past.get(t) for t in expected} == expected
    assert births[0]["parameters/R/value"]["value"] == parameters_at(1002.0)[0].value  # the last is the present


def test_history_of_a_drive_that_is_away_now_has_its_birth_and_death() -> None:
    drive = Drive()
    encoding = Sparkplug("g", "n", lambda: T0)
    encoding.will()
    past = report_of(drive, drive.snapshot(), T0)
    drive.lose("down", "unplugged")
    encoding.birth([report_of(drive, drive.snapshot(), T0)])
    told = encoding.kept(Item(1, "state", "axis1", past.body()))
    assert [m.topic.split("/")[2] for m in told] == ["DBIRTH", "DDATA", "DDEATH"]
    metrics = by_name(read(told[0].payload))
    assert "is_null" in metrics["parameters/R/value"]  # the present is not known
    values = {m["alias"]: m for m in read(told[1].payload)["metrics"]}
    of_R = values[metrics["parameters/R/value"]["alias"]]
    assert (of_R["value"], of_R["is_historical"]) == (past.parameters[0].value, 1)


def test_a_drive_that_is_not_known_yet_is_born_without_values() -> None:
    drive = Drive()
    past = report_of(drive, drive.snapshot(), T0)
    encoding = Sparkplug("g", "n", lambda: T0)
    encoding.will()
    encoding.birth([])
    born, told, _ = encoding.kept(Item(1, "state", "axis1", past.body()))
    assert "is_null" in by_name(read(born.payload))["parameters/R/value"]
    assert past.parameters[0].value in [m["value"] for m in read(told.payload)["metrics"]]
    encoding.state(past)
    assert [m.topic.split("/")[2] for m in encoding.gone("axis1")] == ["DDEATH"]


def test_numbers_begin_anew_after_255() -> None:
    drive = Drive()
    encoding = Sparkplug("g", "n", lambda: T0)
    deaths = [by_name(read(encoding.will().payload))["bdSeq"]["value"] for _ in range(257)]
    assert deaths == [*range(256), 0]
    encoding.birth([report_of(drive, drive.snapshot(), T0)])
    reports = [report_of(drive, make_snapshot(t=float(t)), T0) for t in range(2, 300)]
    sequence = [read(m.payload)["seq"] for report in reports for m in encoding.state(report)]
    assert sequence == [k % 256 for k in range(2, 300)]
