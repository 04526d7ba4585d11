"""Small parts of `DriveRuntime`: counters, runs of blocks, a stale estimate, the drive's own estimates."""

from __future__ import annotations

from dataclasses import replace

from drivers.base import OnboardEstimates
from servo_daemon.daemon.lines.reader import Link, Reader
from servo_daemon.published.snapshot import Estimate, EstimatorView
from servo_daemon.samples import SampleBlock

#: A drive that has not told its estimates for so long, s, has stopped doing so.
_OLD_S = 10.0
#: Statuses whose numbers are not to be used.
_NO_VALUE = ("starting", "invalid")


def same_channels(blocks: list[SampleBlock]) -> list[list[SampleBlock]]:
    """Neighbouring blocks that can be joined: the same channels, and no restart inside."""
    runs: list[list[SampleBlock]] = []
    for block in blocks:
        joins = runs and runs[-1][-1].channels == block.channels and runs[-1][-1].time_s[-1] < block.time_s[0]
        if joins:
            runs[-1].append(block)
        else:
            runs.append([block])
    return runs


def stale(estimate: Estimate, link: Link) -> Estimate:
    """The last estimate of a drive that does not speak now: values stay, their status says so."""
    why = link.reason or "the drive is not connected"
    if link.connection == "ended":
        return estimate
    parameters = tuple(replace(p, status="invalid", reason=why) for p in estimate.parameters)
    return replace(estimate, parameters=parameters)


def line_counters(reader: Reader, repeated: int, failures: int) -> dict[str, int]:
    """Totals of driver and queue.

    Args:
        repeated: samples that the pipeline left out because they came twice.
        failures: of the pipeline.
    """
    c = reader.driver.counters
    return {
        "samples": c.samples,
        "samples_lost": c.samples_lost + reader.queue.dropped,
        "queue_dropped": reader.queue.dropped,
        "queue_samples": reader.queue.samples,
        "samples_repeated": c.samples_repeated + repeated,
        "frames": c.frames,
        "crc_errors": c.crc_errors,
        "framing_errors": c.framing_errors,
        "unknown_frames": c.unknown_frames,
        "device_restarts": c.device_restarts,
        "reconnects": reader.reconnects,
        "pipeline_failures": failures,
        **c.extra,
    }


def with_onboard(estimate: Estimate | None, told: OnboardEstimates | None, now_s: float) -> Estimate | None:
    """The estimate with `estimators.onboard`: of the model's parameters, none where the drive has no value yet.

    Args:
        now_s: on the monotonic clock.
    """
    if estimate is None or told is None or now_s - told.heard_s > _OLD_S:
        return estimate
    names = [p.name for p in estimate.parameters if p.name in told.values]
    values = {name: (None, None) if told.status in _NO_VALUE else told.values[name] for name in names}
    view = EstimatorView(values, {"status": told.status, "age_s": round(now_s - told.heard_s, 3)})
    return replace(estimate, estimators={**estimate.estimators, "onboard": view})
