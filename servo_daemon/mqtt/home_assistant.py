"""Home Assistant's discovery by device: one retained message tells of a drive's entities.

https://www.home-assistant.io/integrations/mqtt/#device-discovery-payload (Home Assistant 2024.11 or newer)
"""

from __future__ import annotations

import json
import re
from typing import Any, Final, get_args

from servo_daemon import __version__
from servo_daemon.mqtt.encoding import Message
from servo_daemon.mqtt.report import Report
from servo_daemon.parameters import J_D
from servo_daemon.plant.effects import parameter_table
from servo_daemon.published.sinks import encode
from servo_daemon.published.snapshot import Connection
from servo_daemon.published.units import split_unit

#: Home Assistant's classes of sensors, for the units that have one.
_DEVICE_CLASS: Final = {"A": "current", "V": "voltage", "°C": "temperature", "Hz": "frequency", "s": "duration"}

Components = dict[str, dict[str, Any]]


class Discovery:
    """Of all drives of a daemon.

    Args:
        discovery_prefix: as Home Assistant is configured.
        topic_prefix: of the states (see `Plain`).
        node: the daemon's name among others.
    """

    def __init__(self, discovery_prefix: str, topic_prefix: str, node: str) -> None:
        self._base, self._topic_prefix = f"{discovery_prefix}/device", topic_prefix
        self._node = f"servo-daemon_{_clean(node)}_"
        self._told: dict[str, dict[str, Any]] = {}  # topic -> the message
        self._known: dict[str, dict[str, str]] = {}  # topic -> platforms by component that the broker may know

    @property
    def topics(self) -> str:
        """Where the messages are that an earlier run left at the broker, among those of others."""
        return f"{self._base}/+/config"

    def of(self, report: Report, again: bool) -> list[Message]:
        """What has to be told before this report.

        Args:
            again: also what was told before: the broker may have lost it.
        """
        identity, topic = self._node + _clean(report.drive), self._topic(report.drive)
        document = self._document(identity, report)
        if document == self._told.get(topic) and not again:
            return []
        self._told[topic] = document
        return self._messages(topic)

    def heard(self, topic: str, payload: bytes) -> list[Message]:
        """The answer to a discovery message at the broker: what a drive of ours no longer has is taken away."""
        if not topic.startswith(f"{self._base}/{self._node}"):
            return []
        try:
            components = json.loads(payload)["components"]
            there = {str(key): str(c["platform"]) for key, c in components.items() if "unique_id" in c}
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return []
        known = self._known.setdefault(topic, {})
        known.update(there)
        told = self._told.get(topic)  # None: the drive's first report will answer
        return [] if told is None or known.keys() <= told["components"].keys() else self._messages(topic)

    def gone(self, drive: str) -> list[Message]:
        """Take the drive's device away."""
        topic = self._topic(drive)
        self._told.pop(topic, None)
        self._known.pop(topic, None)
        return [Message(topic, b"", retain=True)]

    def _topic(self, drive: str) -> str:
        return f"{self._base}/{self._node}{_clean(drive)}/config"

    def _messages(self, topic: str) -> list[Message]:
        """The message; before it one that takes away what is no longer there, as Home Assistant wants it."""
        document = self._told[topic]
        components: Components = document["components"]
        gone = {k: {"platform": p} for k, p in self._known.get(topic, {}).items() if k not in components}
        self._known[topic] = {key: str(c["platform"]) for key, c in components.items()}
        told = [document] if not gone else [{**document, "components": {**components, **gone}}, document]
        return [Message(topic, encode(d), retain=True) for d in told]

    def _document(self, identity: str, report: Report) -> dict[str, Any]:
        return {
            "device": {
                "identifiers": [identity],
                "name": f"Servo {report.drive}",
                "model": f"DC servo drive ({report.driver})",
                "sw_version": __version__,
            },
            "origin": {"name": "servo-daemon", "sw_version": __version__},
            "availability": [{"topic": f"{self._topic_prefix}/status"}],
            "state_topic": f"{self._topic_prefix}/{report.drive}/state",
            "qos": 1,
            "components": {
                key: {**component, "unique_id": f"{identity}_{key}"}
                for key, component in _components(report, f"{self._topic_prefix}/{report.drive}/state").items()
            },
        }


def _components(report: Report, state_topic: str) -> Components:
    found: Components = {
        "connection": {
            "platform": "sensor",
            "name": "Connection",
            "device_class": "enum",
            "options": list(get_args(Connection)),
            "entity_category": "diagnostic",
            "value_template": "{{ value_json.connection }}",
        },
        "alarm": _alarm("Alarm", "value_json.alarm"),
    }
    for p in report.parameters:
        of = f"value_json.parameters.get('{p.name}', {{}})"
        sensor = _sensor(_parameter_name(p.name), p.unit, f"{of}.get('value')")
        attributes = {"json_attributes_topic": state_topic, "json_attributes_template": f"{{{{ {of} | tojson }}}}"}
        found[p.name] = {**sensor, **attributes}
    for name in report.state:
        stem, unit = split_unit(name)
        found[name] = _sensor(stem.capitalize(), unit, f"value_json.state.get('{name}')")
    for name in report.alarms:
        found[f"alarm_{name}"] = _alarm(f"Alarm {name}", f"value_json.alarms.get('{name}')")
    return found


def _sensor(name: str, unit: str | None, value: str) -> dict[str, Any]:
    """A null value is rendered as "None", which Home Assistant shows as unknown."""
    found = {
        "platform": "sensor",
        "name": name,
        "state_class": "measurement",
        "unit_of_measurement": unit if unit != "1" else None,
        "device_class": _DEVICE_CLASS.get(unit or ""),
        "value_template": f"{{{{ {value} }}}}",
    }
    return {key: text for key, text in found.items() if text}


def _alarm(name: str, value: str) -> dict[str, Any]:
    template = f"{{{{ {{true: 'ON', false: 'OFF'}}.get({value}) }}}}"
    return {"platform": "binary_sensor", "name": name, "device_class": "problem", "value_template": template}


def _parameter_name(name: str) -> str:
    """ "Armature resistance R" """
    parameter = J_D if name == J_D.name else parameter_table().get(name)
    words = "" if parameter is None else re.split(r" \(| = |, ", parameter.description)[0]
    return f"{words[:1].upper()}{words[1:]} {name}".strip()


def _clean(name: str) -> str:
    return re.sub(r"[^a-zA-Z0-9_-]", lambda m: f"_{ord(m[0]):x}_", name)
