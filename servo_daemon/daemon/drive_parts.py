"""What `DriveRuntime` computes without being asked about itself: counters, runs of blocks, a stale estimate."""

from __future__ import annotations

from dataclasses import replace

from servo_daemon.daemon.lines.reader import Link, Reader
from servo_daemon.published.snapshot import Estimate
from servo_daemon.samples import SampleBlock


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
