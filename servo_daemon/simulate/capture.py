"""A whole capture at once: what `servo-daemon simulate` writes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from servo_daemon import __version__
from servo_daemon.errors import BadInputError
from servo_daemon.samples import SampleBlock
from servo_daemon.simulate.drive import SimulatedDrive
from servo_daemon.simulate.settings import make_settings

_MOST_SAMPLES = 100_000_000  # about 5 GB of memory


def simulate_capture(
    *,
    effects: Iterable[str] | Mapping[str, Any] = (),
    seconds: float = 60.0,
    rate_hz: float = 1000.0,
    seed: int = 0,
    ageing: Mapping[str, str | Sequence[str]] | Sequence[str] = (),
    command: str | None = None,
    **more: Any,
) -> tuple[SampleBlock, dict[str, str]]:
    """Simulates `seconds` of a drive.

    Args:
        effects, seconds, rate_hz, seed, ageing: see `make_settings`.
        command: the command line that asked for it, for the metadata.
        more: further arguments of `make_settings` (motor, J_m, motion, sensors, …).

    Returns:
        All samples as one block, and the capture's metadata: how it was made and the true values. `truth_P` is P's
        value at the first sample; what ages has `truth_end_P`, its value at the last sample, too.

    Raises:
        BadInputError: an argument is unknown or impossible; one line naming it.
    """
    settings = make_settings(effects=effects, seconds=seconds, rate_hz=rate_hz, seed=seed, ageing=ageing, **more)
    n = max(1, round(seconds * rate_hz))
    if n > _MOST_SAMPLES:
        raise BadInputError(f"{seconds:g} s at {rate_hz:g} Hz are {n:,} samples: the most is {_MOST_SAMPLES:,}")
    drive = SimulatedDrive(settings)
    start = drive.truth()
    block = drive.next_block(n)
    end = drive.truth()
    metadata = {
        "generator": f"servo-daemon {__version__} simulate",
        "model": ",".join(settings.model.effects) or "linear",
        "plant": settings.model.content_hash,
        "seed": str(seed),
        "rate_hz": f"{rate_hz:g}",
        "supply_V": f"{settings.supply_V:g}",
    }
    if command is not None:
        metadata["command"] = command
    if settings.sensors.counts_per_rev:
        metadata["counts_per_rev"] = f"{settings.sensors.counts_per_rev:g}"
    if settings.ageing.motor_inertia is not None:
        metadata["J_m"] = repr(settings.ageing.motor_inertia)
    metadata |= {f"truth_{name}": repr(value) for name, value in start.items()}
    metadata |= {
        f"truth_end_{name}": repr(value) for name, value in end.items() if _ages(settings.ageing.changing, name)
    }
    return block, metadata


def _ages(changing: tuple[str, ...], name: str) -> bool:
    return name in changing or (name == "J_d" and "J" in changing)
