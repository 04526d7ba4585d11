"""What a drive with our own CAN frames says of itself: the pages of its Description frames."""

from __future__ import annotations

import logging
import math
from importlib.resources import as_file, files

import numpy as np

from drivers.can.decode import CLASSIC_BYTES, Field, find_field, load_dbc
from drivers.can.ours.wire import WIRE_VERSION
from servo_daemon.samples import F64, U8

log = logging.getLogger(__name__)

DESCRIBED = ("SamplePeriod", "VoltageLsb", "CurrentLsb", "CountsPerRev")


class Description:
    """One drive's Description as far as it has been heard.

    Args:
        identity: the drive, for messages.
        counts_per_rev: overrides what the drive says; negative turns the direction round.

    Attributes:
        known: what has been said, by name; complete with all of `DESCRIBED`.
        units: shape (4, 1), what one unit of voltage (V), current (A), position (rad) and time (s) is; None until
            `known` is complete.
    """

    def __init__(self, identity: str, counts_per_rev: float | None) -> None:
        self._identity, self._counts_per_rev = identity, counts_per_rev
        self._fields = _fields()
        self._told_version = False
        self.reset()

    def reset(self) -> None:
        """Forget everything said."""
        self.known: dict[str, float] = {}
        self.units: F64 | None = None
        self._heard: dict[int, bytes] = {}

    def has_said(self, frame: U8) -> bool:
        """Whether these bytes, shape (8 or more,), are the page as it was last heard: once a second all is repeated."""
        payload = frame[:CLASSIC_BYTES].tobytes()
        return self._heard.get(payload[0]) == payload

    def news(self, frame: U8) -> dict[str, float]:
        """What this frame says that is not known; to be given to `learn` where it shall begin to hold."""
        if self.has_said(frame):
            return {}
        payload = frame[:CLASSIC_BYTES].tobytes()
        self._heard[payload[0]] = payload
        return dict(self._page(frame[np.newaxis]).items() - self.known.items())

    def learn(self, news: dict[str, float]) -> None:
        """Take over what `news` returned."""
        self.known |= news
        if len(self.known) == len(DESCRIBED):
            rad = 2 * math.pi / (self._counts_per_rev or self.known["CountsPerRev"])
            self.units = np.array([[self.known["VoltageLsb"]], [self.known["CurrentLsb"]], [rad], [1e-6]])

    def _page(self, frame: U8) -> dict[str, float]:
        """Of a frame, shape (1, 8 or more); a zero scale says nothing, nor does a version we do not know."""
        page = {f.name.partition(".")[2]: float(f.physical(frame)[0]) for f in self._fields if f.present(frame)[0]}
        version = page.pop("WireVersion", WIRE_VERSION)
        if version != WIRE_VERSION:
            if not self._told_version:
                log.warning("%s: version %g of the CAN frames, not %d: ignored", self._identity, version, WIRE_VERSION)
            self._told_version = True
            return {}
        return {name: value for name, value in page.items() if value > 0}


def _fields() -> tuple[Field, ...]:
    """The signals of the Description frame, from the DBC that is packaged with the drivers."""
    with as_file(files("drivers") / "servo.dbc") as path:
        database = load_dbc(path)
    return tuple(find_field(database, f"Description.{name}", "servo.dbc") for name in ("WireVersion", *DESCRIBED))
