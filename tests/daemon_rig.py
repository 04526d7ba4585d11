"""A daemon in this process, with drives that do what the test says: no port, no server."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pytest

from drivers.base import DriveInfo, Driver, OnboardEstimates
from servo_daemon.config import Config, parse_config
from servo_daemon.daemon import daemon as daemon_module
from servo_daemon.daemon.daemon import Daemon
from servo_daemon.daemon.drive import DriveRuntime
from servo_daemon.daemon.lines import reader as reader_module
from servo_daemon.daemon.notify import Notifier
from servo_daemon.published.snapshot import Snapshot
from servo_daemon.samples import SampleBlock
from servo_daemon.simulate import DEFAULT_NOMINAL, SimulatedDrive, make_settings

PATIENCE_S = 30.0


class Fed(Driver):
    """A drive into which the test puts blocks and errors."""

    kind: ClassVar[str] = "fed"
    onboard: OnboardEstimates | None = None

    def __init__(self, name: str, options: dict[str, Any]) -> None:
        super().__init__(name, options)
        self.source = SimulatedDrive(make_settings(seed=int(options.get("seed", 1))))
        self.identity = self.source.info.identity
        self._ready = threading.Condition()
        self._next: list[SampleBlock | Exception] = []
        self.fed = 0

    @property
    def info(self) -> DriveInfo:
        return replace(self.source.info, identity=self.identity)

    def feed(self, n: int) -> SampleBlock:
        """The next n samples of its motor."""
        block = self.source.next_block(n)
        self.put(block)
        return block

    def put(self, what: SampleBlock | Exception) -> None:
        if not isinstance(what, Exception):
            self.fed += len(what)
        with self._ready:
            self._next.append(what)
            self._ready.notify_all()

    def _open(self) -> None:
        pass

    def _read(self, timeout_s: float) -> SampleBlock | None:
        with self._ready:
            self._ready.wait_for(lambda: self._next, timeout_s)
            if not self._next:
                return None
            what = self._next.pop(0)
        if isinstance(what, Exception):
            raise what
        return what

    def _close(self) -> None:
        pass


class Rig:
    """A daemon, running unless told otherwise."""

    def __init__(self, daemon: Daemon) -> None:
        self.daemon = daemon

    def runtime(self, name: str = "axis1") -> DriveRuntime:
        return self.daemon.drives[name]  # type: ignore[return-value]

    def driver(self, name: str = "axis1") -> Fed:
        driver = self.runtime(name).reader.driver
        assert isinstance(driver, Fed)
        return driver

    def snapshot(self, name: str = "axis1") -> Snapshot:
        return self.daemon.drives[name].snapshot()

    def kinds(self, name: str = "axis1") -> list[str]:
        return [e.kind for e in self.daemon.drives[name].events()]

    def until(self, condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline, f"{what}: {[self.snapshot(n) for n in self.daemon.drives]}"
            time.sleep(0.002)

    def until_samples(self, n: int, name: str = "axis1") -> Snapshot:
        def there() -> bool:
            estimate = self.snapshot(name).estimate
            return estimate is not None and estimate.samples >= n

        self.until(there, f"{n} samples of {name}")
        return self.snapshot(name)

    def statuses(self, name: str = "axis1") -> set[str]:
        estimate = self.snapshot(name).estimate
        assert estimate is not None
        return {p.status for p in estimate.parameters}


def configuration(*names: str, **extra: Any) -> Config:
    # A model that somebody has trained on this machine must not take part unasked.
    extra["estimation"] = {"refresh": False} | extra.get("estimation", {})
    drives = [{"name": n, "driver": "fed", "nominal": dict(DEFAULT_NOMINAL)} | extra for n in names or ("axis1",)]
    return parse_config({"drive": drives, "storage": {"save_interval_s": 0.05}})


@contextlib.contextmanager
def starter(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Rig]]:
    """Starts daemons whose drives are `Fed`; stops them at the end. For a fixture. A drive that has nothing to say for
    a while is not silent: the machine may be slow."""
    monkeypatch.setattr(reader_module, "SILENT_AFTER_S", 600.0)
    monkeypatch.setattr(reader_module, "_BACKOFF_FIRST_S", 0.01)
    monkeypatch.setattr(daemon_module, "make_driver", lambda kind, name, options: Fed(name, options))
    with contextlib.ExitStack() as stack:

        def begin(
            config: Config | None = None,
            state: Path | None = None,
            *,
            run: bool = True,
            notifier: Notifier | None = None,
        ) -> Rig:
            daemon = Daemon(config or configuration(), state, notifier)
            stack.callback(daemon.stop, PATIENCE_S)
            if run:
                daemon.start()
            return Rig(daemon)

        yield begin
