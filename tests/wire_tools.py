"""For the tests of the serial wire: a small device on paper, and the golden vectors of docs/protocol.md."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.serial.frame import encode_frame
from drivers.serial.wire import Channel, Description, Quantity, encode_description, encode_samples

PERIOD_US = 1000

SERVO = Description(
    drive_id=7,
    session=1,
    channels=(
        Channel(Quantity.VOLTAGE, 2, 0.001),
        Channel(Quantity.CURRENT, 2, 0.0005),
        Channel(Quantity.POSITION, 4, 4096.0),
        Channel(Quantity.STATUS, 1),
    ),
    identity="TEST-1",
    sample_period_ns=PERIOD_US * 1000,
)


def with_position(description: Description, position: Channel, **changes: int) -> Description:
    """The same device with another encoder."""
    channels = tuple(position if c.quantity == Quantity.POSITION else c for c in description.channels)
    return replace(description, channels=channels, **changes)


def describe(description: Description = SERVO) -> bytes:
    """A description frame."""
    return encode_frame(encode_description(description))


def frame(
    first: int,
    *,
    n: int = 10,
    description: Description = SERVO,
    start_us: int | None = None,
    counts: list[int] | None = None,
    status: int = 0,
) -> bytes:
    """A frame of samples first .. first + n - 1: voltage k mod 1000 mV, current -(k mod 1000) * 0.5 mA, position 3 k
    counts unless given, taken every PERIOD_US from 0 on unless told."""
    k = first + np.arange(n)
    t_us = PERIOD_US * k if start_us is None else start_us + PERIOD_US * np.arange(n)
    position = 3 * k if counts is None else np.array(counts)
    columns = [k % 1000, -(k % 1000), position, np.full(n, status)]
    return encode_frame(encode_samples(description, first, t_us, columns))


def frames(start: int, stop: int, *, n: int = 10, description: Description = SERVO) -> list[bytes]:
    """Frames of n samples each, from sample `start` up to `stop`."""
    return [frame(k, n=n, description=description) for k in range(start, stop, n)]


PROTOCOL = Path(__file__).parents[1] / "docs" / "protocol.md"


def read_vectors() -> dict[str, dict[str, Any]]:
    """The golden vectors, from the very text a firmware engineer reads."""
    blocks = re.findall(r"```toml\n(\[\w+\]\n.*?)```", PROTOCOL.read_text(encoding="utf-8"), re.DOTALL)
    return {name: v for block in blocks for name, v in tomllib.loads(block).items() if "payload" in v}


VECTORS = read_vectors()
DESCRIPTIONS = {name: v for name, v in VECTORS.items() if "channels" in v}
SAMPLES = {name: v for name, v in VECTORS.items() if "description" in v}
COMMANDS = {name: v for name, v in VECTORS.items() if "enabled" in v}


def description_of(vector: dict[str, Any]) -> Description:
    return Description(
        drive_id=vector["drive_id"],
        session=vector["session"],
        channels=tuple(Channel(*c) for c in vector["channels"]),
        identity=vector["identity"],
        sample_period_ns=vector["sample_period_ns"],
        position_modulus=vector["position_modulus"],
    )


def rows_of(vector: dict[str, Any]) -> tuple[list[int], list[list[int]]]:
    """Times, not yet wrapped back, and rows of integers."""
    if "count" in vector:
        times = [vector["t_us_first"] + k * vector["t_us_step"] for k in range(vector["count"])]
        return times, [vector["value"]] * vector["count"]
    first = vector["t_us"][0]
    return [first + (t - first) % 2**32 for t in vector["t_us"]], vector["values"]
