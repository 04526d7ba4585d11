"""The connection to the broker: one thread, one client a connection, back-off between them."""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from servo_daemon.background import Background
from servo_daemon.config.credentials import file_of
from servo_daemon.config.sinks import MqttConfig
from servo_daemon.errors import ConfigError, ServoDaemonError
from servo_daemon.mqtt.encoding import Encoding, Message
from servo_daemon.mqtt.outbox import Outbox
from servo_daemon.mqtt.report import Report

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessageInfo

log = logging.getLogger(__name__)

#: A broker that says nothing is given up after one and a half of this, s (MQTT 3.1.1, 3.1.2.10).
_KEEPALIVE_S: Final = 15
#: A broker that does not answer the first packet is given up, s.
_ANSWER_S: Final = 10.0
#: Between two attempts: doubled each time, up to the second; random between half and all of it.
_RETRY_S: Final = (1.0, 60.0)
#: The longest wait for something to come or to become due, s.
_TURN_S: Final = 0.1
#: At the end the broker may take so long to take the last messages, s: a stop of the daemon takes less than two.
_OFFLINE_S: Final = 0.4
#: Of the queue so many are under way at a time.
_BATCH: Final = 50


class _LostError(Exception):
    """There is no connection (any more); the text says why."""


class Link(Background):
    """Publishes what the encoding makes of the outbox; at the stop, that it ends.

    Args:
        client_id: of MQTT, the daemon's own on the broker.

    Raises:
        ConfigError: paho-mqtt is not installed, or a file of the configuration cannot be read.
    """

    def __init__(self, config: MqttConfig, client_id: str, encoding: Encoding, outbox: Outbox) -> None:
        super().__init__("mqtt")
        self._config, self._client_id, self._encoding, self._outbox = config, client_id, encoding, outbox
        self._under_way: list[tuple[MQTTMessageInfo, Sequence[Report]]] = []
        self._batch_end = 0  # number of the last item of the queue that is under way; 0: none is
        self._refusal: str | None = None
        self._accepted = False
        self.connected: bool | None = None
        self.reason: str | None = None
        self.sent = self.connections = 0
        self._client(Message("servo-daemon", b""))  # what is wrong with the configuration is told at the start

    def _client(self, will: Message) -> Client:
        """A client as configured; its files are read now, so that new ones are taken up."""
        try:
            from paho.mqtt.client import Client, MQTTv311
            from paho.mqtt.enums import CallbackAPIVersion
        except ImportError as error:
            raise ConfigError("[mqtt] needs paho-mqtt: pip install 'servo-daemon[mqtt]'") from error
        c = self._config
        client = Client(CallbackAPIVersion.VERSION2, self._client_id, protocol=MQTTv311)
        client.will_set(will.topic, will.payload, will.qos, will.retain)
        if c.username is not None:
            client.username_pw_set(c.username, None if c.password_file is None else _password(c.password_file))
        if c.tls:
            keys = {key: getattr(c, key) for key in ("ca_file", "certificate", "private_key")}
            files = [None if text is None else str(file_of(text, f"[mqtt] {key}")) for key, text in keys.items()]
            authority, certificate, private_key = files
            try:
                client.tls_set(authority, certificate, private_key)
            except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
                raise ConfigError(f"[mqtt] {', '.join(filter(None, files))}: not usable for TLS: {error}") from error
        client.on_connect = self._answered
        client.on_message = self._heard
        return client

    # -- the thread ------------------------------------------------------------------------------------------

    def _run(self) -> None:
        pause = _RETRY_S[0]
        while not self._stop.is_set():
            try:
                self._session()
            except (_LostError, OSError, ValueError, ServoDaemonError) as error:
                self._lost(f"{self._where}: {getattr(error, 'strerror', None) or error}")
            except Exception as error:  # an error in the program must not end the thread
                log.exception("mqtt: the connection failed")
                self._lost(f"{self._where}: {error}")
            if self._accepted:
                pause = _RETRY_S[0]
            self._stop.wait(pause * random.uniform(0.5, 1.0))
            pause = min(2.0 * pause, _RETRY_S[1])

    @property
    def _where(self) -> str:
        return f"{self._config.host}:{self._config.port_number}"

    def _session(self) -> None:
        self._accepted, self._refusal = False, None
        client = self._client(self._encoding.will())
        try:
            client.connect(self._config.host, self._config.port_number, _KEEPALIVE_S)
            self._wait_for_answer(client)
            while not self._stop.is_set():
                self._send(client)
                self._turn(client)
            self._go_offline(client)
        finally:
            self.connected = False
            unsent = [report for info, reports in self._under_way if not _arrived(info) for report in reports]
            self._under_way, self._batch_end = [], 0
            self._outbox.close(unsent)
            _disconnect(client)

    def _wait_for_answer(self, client: Client) -> None:
        deadline = time.monotonic() + _ANSWER_S
        while not self._accepted:
            self._turn(client)
            if self._stop.is_set() or time.monotonic() > deadline:
                raise _LostError("the broker does not answer")
        for topic in self._encoding.topics:
            client.subscribe(topic, 1)
        reports = self._outbox.open()
        *first, last = self._encoding.birth(reports)
        for message in first:
            self._publish(client, message)
        self._publish(client, last, reports)
        if self.reason is not None:
            log.info("mqtt: %s: connected", self._where)
        self.connected, self.reason = True, None
        self.connections += 1

    def _turn(self, client: Client) -> None:
        """Wait for the network, and work off what it brings."""
        code = client.loop(_TURN_S)
        if self._refusal is not None:
            raise _LostError(self._refusal)
        if code:
            from paho.mqtt.client import error_string

            raise _LostError(error_string(code).rstrip("."))

    def _send(self, client: Client) -> None:
        arrived = [entry for entry in self._under_way if _arrived(entry[0])]
        self.sent += len(arrived)
        self._under_way = [entry for entry in self._under_way if entry not in arrived]
        for drive in self._outbox.take_gone():
            for message in self._encoding.gone(drive):
                self._publish(client, message)
        for report in self._outbox.take():
            for message in self._encoding.state(report):
                self._publish(client, message, [report])
        self._send_kept(client)

    def _send_kept(self, client: Client) -> None:
        """The queue's next items, when those before have arrived with all that went out beside them."""
        if self._batch_end and not self._under_way:
            self._outbox.queue.remove(self._batch_end)
            self._batch_end = 0
        if not self._batch_end and (items := self._outbox.queue.head(_BATCH)):
            self._batch_end = items[-1].number
            for item in items:
                for message in self._encoding.kept(item):
                    self._publish(client, message)

    def _publish(self, client: Client, message: Message, reports: Sequence[Report] = ()) -> None:
        """
        Args:
            reports: what has arrived with this message.

        Raises:
            _LostError: the connection is gone.
        """
        info = client.publish(message.topic, message.payload, message.qos, message.retain)
        self._under_way.append((info, reports))
        if info.rc:
            raise _LostError("the connection is lost")

    def _go_offline(self, client: Client) -> None:
        """Publish that it ends; what else is under way may arrive meanwhile."""
        for message in self._encoding.death():
            self._publish(client, message)
        deadline = time.monotonic() + _OFFLINE_S
        while time.monotonic() < deadline and not all(_arrived(info) for info, _ in self._under_way):
            self._turn(client)
        if self._batch_end and all(_arrived(info) for info, _ in self._under_way):
            self._outbox.queue.remove(self._batch_end)

    def _lost(self, text: str) -> None:
        """Told once, until there is a connection again."""
        if self.reason is None:
            log.warning("mqtt: %s; tried again, and what is to be sent is kept", text)
        self.reason = text

    # -- called by the client, within `_turn` ----------------------------------------------------------------

    def _answered(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._refusal = f"the broker refuses the connection: {reason}"
        else:
            self._accepted = True

    def _heard(self, client: Client, _data: Any, message: Any) -> None:
        for answer in self._encoding.heard(message.topic, message.payload):
            self._publish(client, answer)


def _arrived(info: MQTTMessageInfo) -> bool:
    return not info.rc and info.is_published()


def _disconnect(client: Client) -> None:
    """Close in order, where there is still somebody."""
    client.disconnect()
    client.loop(0.0)


def _password(text: str) -> str:
    """The first line of `password_file`.

    Raises:
        ConfigError: it cannot be read.
    """
    path = file_of(text, "[mqtt] password_file")
    try:
        return next(iter(path.read_text(encoding="utf-8").splitlines()), "")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"[mqtt] password_file {path}: cannot be read: {error}") from error
