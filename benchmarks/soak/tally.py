"""What a soak found, and how it is told."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from benchmarks.soak.drives import RATE_HZ
from benchmarks.soak.service import Service
from drivers.can.ours.wire import SYNC_PERIOD_S

#: A machine without time, where a terminal may run over without anybody's fault: a device was kept from running for
#: so long, s (a terminal holds more than that of a wire), or the daemon's threads waited for a processor for so much of
#: the time (on a machine with nothing else to do: a few per cent).
BUSY_S, BUSY_SHARE = 0.5, 0.25
#: Memory before this much of the first life grows to its working size, s.
_WARM_S = 60.0


#: Drives on serial lines, which come first, and on slcan.
SERIAL, SLCAN = 4, 4
#: Samples of a CAN drive from one Sync to the next: they may wait in the decoder until a Sync dates them, and where
#: between two Syncs a pause begins is chance. (What is lost shows besides as a gap in the numbers, `told`.)
UNDATED = round(SYNC_PERIOD_S * RATE_HZ)


@dataclass(frozen=True)
class Quiet:
    """While the drives paused; counts since the drives' (`sent`, `no_room`) and the daemon's start.

    Attributes:
        late_s: longest time that a device was kept from running since the last pause, s.
        behind: samples sent whole that have not gone through the estimators.
        received: samples that the daemon has read.
        told: what the daemon itself counts as lost.
        no_room: frames (slcan: lines) that a terminal had no room for.
        waited_s: time the daemon's threads were kept waiting for a processor.
    """

    time_s: float
    sent: tuple[int, ...]
    behind: tuple[int, ...]
    received: tuple[int, ...]
    told: tuple[int, ...]
    no_room: tuple[int, ...]
    late_s: float
    waited_s: float
    memory_MB: float


@dataclass(frozen=True)
class Stretch:
    """From one pause to the next, with a fault between. `exempt`: drives whose port was away."""

    fault: str
    first: Quiet
    last: Quiet
    exempt: set[int]

    def by_drive(self, name: str) -> list[int]:
        """How much a count has grown; 0 of those exempt."""
        pairs = zip(getattr(self.first, name), getattr(self.last, name), strict=True)
        return [0 if k in self.exempt else b - a for k, (a, b) in enumerate(pairs)]

    def __str__(self) -> str:
        """For the log: where something was lost, of which drives, and what the daemon says."""
        text = f"{self.lost} of {self.sent} lost"
        if self.lost or self.no_room:
            text += "".join(f", {n} {self.by_drive(n)}" for n in ("behind", "sent", "received", "told", "no_room"))
            text += f", devices late by {self.last.late_s:.2f} s"
        return f"{text}; {self.last.memory_MB:.1f} MB"

    @property
    def sent(self) -> int:
        return sum(self.by_drive("sent"))

    @property
    def lost(self) -> int:
        """Samples that were sent whole and did not go through the estimators: of a CAN drive those beyond what may wait
        for its Sync."""
        found = 0
        for k, (behind, full) in enumerate(zip(self.by_drive("behind"), self.by_drive("no_room"), strict=True)):
            if not full:
                found += behind if k < SERIAL else max(0, abs(behind) - UNDATED)
        return found

    @property
    def no_room(self) -> int:
        """Frames or lines that a terminal had no room for; of such a drive it is not known which samples were whole."""
        return sum(self.last.no_room) - sum(self.first.no_room)

    @property
    def waited_s(self) -> float:
        return max(0.0, self.last.waited_s - self.first.waited_s)

    @property
    def busy(self) -> bool:
        return self.last.late_s > BUSY_S or self.waited_s > BUSY_SHARE * (self.last.time_s - self.first.time_s)


@dataclass
class Tally:
    """Attributes:
    disk: how the disk was made full.
    left_out: faults for which the machine has no part.
    kills_s: history that each kill cost, s.
    wrong: answers 5xx but 503, and messages that the MQTT sink dropped.
    """

    disk: str
    left_out: set[str] = field(default_factory=set)
    stretches: list[Stretch] = field(default_factory=list)
    kills_s: list[float] = field(default_factory=list)
    stops_s: list[float] = field(default_factory=list)
    gap_s: float = 0.0
    rows_dropped: int = 0
    wrong: int = 0
    corrupt: Sequence[str] = ()
    faults: Sequence[str] = ()

    def take(self, service: Service, wrong: int, corrupt: Sequence[str]) -> None:
        self.stops_s, self.gap_s, self.rows_dropped = service.stops_s, service.signs.longest_s, service.dropped
        self.wrong, self.corrupt, self.faults = wrong, corrupt, service.faults

    @property
    def lost(self) -> int:
        return sum(s.lost for s in self.stretches)

    def slope_MB_h(self) -> tuple[float, float] | None:
        """Memory over time in the first life, and half of its 95 % interval; None: too short to be said.

        Of the pauses; so many of them count as the residuals' first autocorrelation leaves (Santer et al., J. Geophys.
        Res. 105, 2000, equation 6).
        """
        points = [(s.last.time_s, s.last.memory_MB) for s in self.stretches if s.fault != "kill -9"]
        start = points[0][0] if points else 0.0
        time_h, memory = np.array([((t - start) / 3600, m) for t, m in points if t - start > _WARM_S]).reshape(-1, 2).T
        n = len(time_h)
        if n < 6:
            return None
        fit = np.polyfit(time_h, memory, 1)
        residual = memory - np.polyval(fit, time_h)
        alike = float(np.clip(np.corrcoef(residual[:-1], residual[1:])[0, 1], 0.0, 0.95))
        effective = max(3.0, n * (1 - alike) / (1 + alike))
        deviation = math.sqrt(residual @ residual / (effective - 2) / (n * np.var(time_h)))
        return float(fit[0]), float(stats.t.ppf(0.975, effective - 2)) * deviation


def report(tally: Tally) -> str:
    """Tables and lines for docs/benchmarks.md."""
    out = [
        "| fault | times | good samples | lost | no room | longest wait of the daemon |",
        "|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(s.fault for s in tally.stretches):
        of = [s for s in tally.stretches if s.fault == name]
        waited = max(s.waited_s for s in of)
        sums = [sum(getattr(s, field) for s in of) for field in ("sent", "lost", "no_room")]
        out.append(f"| {name} | {len(of)} | {sums[0]:,} | {sums[1]} | {sums[2]} | {waited:.1f} s |")
    full = sum(s.no_room for s in tally.stretches)
    machine = sum(s.no_room for s in tally.stretches if s.busy)
    kills, stops = tally.kills_s or [math.nan], tally.stops_s or [math.nan]
    slope = tally.slope_MB_h()
    out += [
        "",
        "| | measured | limit |",
        "|---|---|---|",
        f"| good samples lost | {tally.lost} of {sum(s.sent for s in tally.stretches):,} | 0 |",
        f"| frames a terminal had no room for | {full}, {machine} of them while the machine was busy | 0 others |",
        f"| history lost by a kill | at most {max(kills):.1f} s, {len(tally.kills_s)} kills | 5 s |",
        f"| rows that the history could not keep | {tally.rows_dropped} | 0 |",
        f"| broken files; wrong answers | {len(tally.corrupt)}; {tally.wrong} | 0 |",
        f"| stop | at most {max(stops):.2f} s, {len(tally.stops_s)} stops | 2 s |",
        f"| from one watchdog sign to the next | at most {tally.gap_s:.2f} s | 2 s |",
        f"| memory slope | {_told(slope)} | 1 MB/h |",
        "",
        f"Disk full: {tally.disk}. Left out for want of a part: {', '.join(sorted(tally.left_out)) or 'nothing'}.",
    ]
    return "\n".join([*out, *tally.corrupt, *tally.faults])


def _told(slope: tuple[float, float] | None) -> str:
    if slope is None:
        return "this length cannot show it"
    value, half = slope
    return f"{value:+.1f} ± {half:.1f} MB/h (95 %): this length shows slopes above {half:.1f} MB/h"
