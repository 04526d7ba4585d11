"""The API never takes the descriptors that state files and ports need."""

from __future__ import annotations

import resource

import pytest

from servo_daemon.daemon.descriptors import room_for_connections


@pytest.mark.parametrize(
    ("limits", "raised", "room"),
    [((1024, 524_288), 4096, 256), ((256, 256), None, 256 - 96 - 2 * 8), ((64, 64), None, 8)],
)
def test_room_for_connections(
    monkeypatch: pytest.MonkeyPatch, limits: tuple[int, int], raised: int | None, room: int
) -> None:
    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda which: limits)
    monkeypatch.setattr(resource, "setrlimit", lambda which, to: asked.append(to))
    assert room_for_connections(2, 256) == room
    assert asked == ([] if raised is None else [(raised, limits[1])])
