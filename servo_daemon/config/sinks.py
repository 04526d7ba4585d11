"""`[mqtt]` and `[[webhook]]`: where estimates and events are sent to."""

from __future__ import annotations

import re
import socket
from typing import Literal
from urllib.parse import urlsplit

from pydantic import Field, field_validator, model_validator

from servo_daemon.config.section import Section

#: MQTT 3.1.1, 4.7.1: wildcards, and 4.7.2: `$` in front is the server's own.
_IN_TOPICS = re.compile(r"[^+#$\x00/][^+#\x00]*")


def _fits_a_topic(text: str, levels: bool) -> str:
    bad_end = text.endswith("/") or "//" in text
    if not _IN_TOPICS.fullmatch(text) or bad_end or ("/" in text and not levels):
        none_of = "+, #, // and no / at its ends" if levels else "+, # and /"
        raise ValueError(f"{text!r} must be text without {none_of}, not beginning with $")
    return text


class MqttConfig(Section):
    """`[mqtt]`: a broker that estimates and events are published to. QoS 1; Sparkplug's own 0."""

    host: str = Field(min_length=1)
    port: int | None = Field(None, ge=1, le=65535)  # None: 1883, with TLS 8883
    node: str | None = None  # this daemon among others on the broker; None: the machine's name
    username: str | None = None
    password_file: str | None = None
    tls: bool = False
    ca_file: str | None = None  # PEM; None: the system's
    certificate: str | None = None  # PEM, where the broker asks for one
    private_key: str | None = None
    interval_s: float = Field(1.0, ge=0.1, le=86400)
    buffer_MB: float = Field(20.0, ge=0.1, le=1e5)  # kept while the broker is away; beyond it the oldest go
    encoding: Literal["json", "sparkplug"] = "json"
    prefix: str | None = None  # of JSON topics; None: servo-daemon/NODE
    home_assistant: bool = False
    discovery_prefix: str = "homeassistant"
    group: str = "servo-daemon"  # Sparkplug's group

    @field_validator("prefix", "discovery_prefix")
    @classmethod
    def _topics(cls, text: str | None) -> str | None:
        return None if text is None else _fits_a_topic(text, levels=True)

    @field_validator("node", "group")
    @classmethod
    def _one_level(cls, text: str | None) -> str | None:
        return None if text is None else _fits_a_topic(text, levels=False)

    @model_validator(mode="after")
    def _belong_together(self) -> MqttConfig:
        if self.password_file is not None and self.username is None:
            raise ValueError("'password_file' needs 'username'")
        if (self.certificate is None) != (self.private_key is None):
            raise ValueError("'certificate' and 'private_key' belong together")
        if (self.ca_file or self.certificate) and not self.tls:
            raise ValueError("'ca_file' and 'certificate' need tls = true")
        if self.home_assistant and self.encoding != "json":
            raise ValueError("'home_assistant' needs encoding = \"json\"")
        return self

    @property
    def port_number(self) -> int:
        """As configured, else the one IANA gave to MQTT or MQTT over TLS."""
        return self.port or (8883 if self.tls else 1883)

    @property
    def node_name(self) -> str:
        """As configured, else the machine's."""
        return self.node or socket.gethostname().replace("/", "_")

    @property
    def topic_prefix(self) -> str:
        """First part of the topics of JSON messages."""
        return self.prefix or f"servo-daemon/{self.node_name}"


class WebhookConfig(Section):
    """One `[[webhook]]`: an address that events are sent to by POST."""

    url: str
    secret_file: str | None = None  # of the signature; None: none is made
    kinds: tuple[str, ...] = ()  # events that are sent; none: all
    drives: tuple[str, ...] = ()  # of these drives; none: of all

    @field_validator("url")
    @classmethod
    def _is_of_the_web(cls, url: str) -> str:
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(f"{url!r} is not an address such as https://example.com/hook")
        if parts.username is not None:
            raise ValueError("a password does not belong into the address: use 'secret_file'")
        return url
