"""What every test may need of the machine: the real captures, and parts of the system that not every machine has."""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, NoReturn

import pytest

ROOT = Path(__file__).resolve().parent.parent

# Byte code is kept whatever the shell says, here and in every process that a test starts: see the Makefile.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False


def pytest_xdist_auto_num_workers() -> int:
    """Half as many again as there are cores: a fifth of the time goes to waiting for processes, ports and clocks."""
    return ((os.cpu_count() or 1) * 3 + 1) // 2


_cases: Counter[str] = Counter()


def pytest_itemcollected(item: pytest.Item) -> None:
    """Of a test marked `first_is_fast` every case but the first is slow."""
    test = item.nodeid.partition("[")[0]
    _cases[test] += 1
    if _cases[test] > 1 and item.get_closest_marker("first_is_fast") is not None:
        item.add_marker(pytest.mark.slow)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected is there to stay: looking through it for garbage is a seventh of the time that
    collecting takes, and much of what each later look would take."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest first: no process is still at one when the others have finished."""

    def seconds(item: pytest.Item) -> float:
        marker = item.get_closest_marker("timeout")
        return float(marker.args[0]) if marker is not None and marker.args else 0.0

    items.sort(key=seconds, reverse=True)


def _missing(what: str) -> NoReturn:
    """A part of the system is not there: a skip that says so; a failure where SERVO_DAEMON_REQUIRE_SYSTEM is set."""
    if os.environ.get("SERVO_DAEMON_REQUIRE_SYSTEM", "") not in {"", "0"}:
        pytest.fail(f"required here (SERVO_DAEMON_REQUIRE_SYSTEM), but missing: {what}", pytrace=False)
    pytest.skip(f"missing: {what}")


@pytest.fixture(scope="session")
def repo_root() -> Path:
    """The source tree."""
    return ROOT


@pytest.fixture(scope="session")
def missing() -> Callable[[str], NoReturn]:
    """`missing("what and why")` skips the test, or fails it where .ci/run demands every part of the system."""
    return _missing


@pytest.fixture(scope="session")
def program() -> Callable[..., str]:
    """`program("chromium", "chromium-browser")` is the path of the first that is installed; see `missing`."""

    def find(*names: str) -> str:
        for name in names:
            if (path := shutil.which(name)) is not None:
                return path
        _missing(" or ".join(names))

    return find


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One for all processes of this run."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def once(run_folder: Path) -> Callable[[str, Callable[[], Any]], Any]:
    """`once("name", make)`: what `make()` gives, made by the first process of this run that asks for the name."""

    def made(name: str, make: Callable[[], Any]) -> Any:
        path = run_folder / f"{name}.pickle"
        with path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                path.write_bytes(pickle.dumps(make()))
        return pickle.loads(path.read_bytes())

    return made


@pytest.fixture(scope="session")
def servo_data() -> Path:
    """The folder of real captures: SERVO_DATA, else ../shared/data beside the source tree."""
    folder = Path(os.environ.get("SERVO_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no real captures: {folder} is not a folder (SERVO_DATA names it)")
    return folder
