"""No room is so large that a reader loses the way, and none stands outside the order of imports."""

from __future__ import annotations

import re
import tomllib
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


def test_every_room_has_its_layer(repo_root: Path) -> None:
    """What the contract does not name may import anything, and be imported by all."""
    contracts = tomllib.loads((repo_root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    (layers,) = [c["layers"] for c in contracts["contracts"] if c["id"] == "layers"]
    named = set(re.findall(r"[\w.]+", " ".join(layers)))
    files = (repo_root / "servo_daemon").iterdir()
    modules = {f.stem for f in files if f.suffix == ".py" or (f / "__init__.py").exists()} - {"__init__"}
    assert {"drivers", *(f"servo_daemon.{name}" for name in modules)} == named
