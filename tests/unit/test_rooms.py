"""No room is so large that a reader loses the way: files and lines of each folder's own level."""

from __future__ import annotations

from pathlib import Path

#: What one sitting reads. `plant/effects/` has one small file an effect, so only its lines count.
_MOST_FILES, _MOST_LINES = 16, 2500
_MANY_FILES = {"servo_daemon/plant/effects"}


def test_every_room_can_be_read_in_one_sitting(repo_root: Path) -> None:
    too_large = {}
    for top in ("servo_daemon", "drivers"):
        for init in (repo_root / top).rglob("__init__.py"):
            files = [f for f in init.parent.glob("*.py") if f != init]
            lines = sum(len(f.read_text(encoding="utf-8").splitlines()) for f in files)
            room = init.parent.relative_to(repo_root).as_posix()
            if lines > _MOST_LINES or (len(files) > _MOST_FILES and room not in _MANY_FILES):
                too_large[room] = (len(files), lines)
    assert too_large == {}
