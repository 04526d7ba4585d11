"""What a user tells of captures beside the files: names and rate of a bare table, and what units depend on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from servo_daemon.errors import BadInputError

Effort = Literal["current", "torque", "force"]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Beside a signal map, or instead of one. None: not told.

    Attributes:
        columns: names of a text table's columns, in order; "-" is a column to be passed over. In place of its header.
        rate_hz: the samples' rate, where the file has no time.
        counts_per_rev: of an encoder whose counts are in the file; negative turns the direction round.
        supply_V: the supply's voltage, of which a duty cycle is a share.
        full_duty: what the duty cycle reads where it is the whole supply (`pwm` of an Arduino: 255), also beside a
            supply's voltage that the file has; None: 1.
        pole_pairs: between a drive's electrical speed or angle and the shaft's.
        joint: which one of a robot's JointState, or which drive of a recording that has several.
        effort: what a JointState's effort is: "current" (A) or "torque" (N·m; of a linear axis "force", N).
    """

    columns: tuple[str, ...] = ()
    rate_hz: float | None = None
    counts_per_rev: float | None = None
    supply_V: float | None = None
    full_duty: float | None = None
    pole_pairs: float | None = None
    joint: str | None = None
    effort: Effort | None = None

    def __post_init__(self) -> None:
        for flag, value in (
            ("--rate", self.rate_hz),
            ("--supply", self.supply_V),
            ("--supply's full scale", self.full_duty),
            ("--pole-pairs", self.pole_pairs),
        ):
            if value is not None and not 0.0 < value < math.inf:
                raise BadInputError(f"{flag} must be a number greater than 0, not {value:g}")
        if self.counts_per_rev is not None and not 0.0 < abs(self.counts_per_rev) < math.inf:
            raise BadInputError(f"--counts-per-rev must be a number other than 0, not {self.counts_per_rev:g}")
        if self.columns and (len(self.columns) < 2 or not all(self.columns)):
            raise BadInputError("--columns needs two names or more, separated by commas; '-' passes a column over")


def parse_supply(text: str) -> tuple[float, float | None]:
    """ "12" or "12/255" as volts, and full scale of the duty cycle if it is told.

    Raises:
        BadInputError: neither.
    """
    volts, _, full = text.partition("/")
    try:
        return float(volts), float(full) if full else None
    except ValueError:
        raise BadInputError(f"--supply: {text!r} is neither volts (12) nor volts over full scale (12/255)") from None
