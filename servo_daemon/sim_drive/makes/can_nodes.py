"""Nodes of a CAN bus behind a simulated USB adapter (SLCAN)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

from servo_daemon.sim_drive.slcan_adapter import BusFrame, SlcanAdapter


class Node(Protocol):
    """A device on the bus.

    Attributes:
        period_s: how often `due` is asked; None: it sends nothing by itself.
    """

    period_s: float | None

    def receive(self, frame: BusFrame) -> Sequence[BusFrame]:
        """Its answers to a frame on the bus."""
        ...

    def due(self) -> Sequence[BusFrame]:
        """What it sends by itself now."""
        ...


class SlcanBus:
    """One node and the adapter, as a `Device` on a pseudo-terminal.

    Attributes:
        heard: every frame that the host has put on the bus.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._adapter = node, SlcanAdapter()
        self.period_s = node.period_s
        self.heard: list[BusFrame] = []

    def receive(self, data: bytes) -> bytes:
        """Answers of the adapter, then the frames with which the node answers."""
        answers = self._adapter.feed(data)
        frames, self._adapter.on_bus = self._adapter.on_bus, []
        self.heard += frames
        return answers + self._lines([answer for frame in frames for answer in self._node.receive(frame)])

    def due(self) -> bytes:
        """The node's own frames; none while the channel is closed."""
        return self._lines(self._node.due())

    def _lines(self, frames: Sequence[BusFrame]) -> bytes:
        if not self._adapter.channel_open:
            return b""
        now_ms = round(time.monotonic() * 1e3)
        line = self._adapter.frame_line
        return b"".join(line(f.frame_id, f.data, now_ms, extended=f.extended) for f in frames)
