"""Starts the real program as a process and reads it by HTTP; everything waits on a condition with a deadline."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import httpx

from servo_daemon.simulate import PAPER_MOTOR
from servo_daemon.simulate.drive import SimulatedDrive

T = TypeVar("T")

ROOT = Path(__file__).resolve().parents[2]
#: Longest anything may take on a loaded machine; nothing here waits longer than it must.
PATIENCE_S = 60.0
#: A clean stop is over within this time (issue 2).
STOP_S = 2.0

LINEAR = tuple(PAPER_MOTOR)
_ADDRESS = re.compile(r"API and dashboard on (https?://\S+)/$")


def wait_for(probe: Callable[[], T | None], what: str, limit_s: float = PATIENCE_S, every_s: float = 0.02) -> T:
    """The first answer of `probe` that is true; fails when there is none in time."""
    deadline = time.monotonic() + limit_s
    while True:
        answer = probe()
        if answer:
            return answer
        assert time.monotonic() < deadline, f"not within {limit_s:g} s: {what}"
        time.sleep(every_s)


def environment(**changes: str) -> dict[str, str]:
    """This process's environment without what would configure the program."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("SERVO_DAEMON_")}
    for name in ("STATE_DIRECTORY", "NOTIFY_SOCKET", "WATCHDOG_USEC", "JOURNAL_STREAM"):
        kept.pop(name, None)
    return kept | {"PYTHONUNBUFFERED": "1"} | changes


def command(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "servo_daemon", *map(str, words)]


def run_once(
    *words: str | Path, env: Mapping[str, str] | None = None, within_s: float = PATIENCE_S
) -> subprocess.CompletedProcess[str]:
    """A command that ends by itself."""
    return subprocess.run(
        command(*words),
        cwd=ROOT,
        env=dict(env or environment()),
        text=True,
        capture_output=True,
        timeout=within_s,
        check=False,
    )


class Program:
    """A running command; its stderr is collected line by line."""

    def __init__(self, *words: str | Path, env: Mapping[str, str] | None = None, stdin: int | None = None) -> None:
        self._lines: list[str] = []
        self.process = subprocess.Popen(
            command(*words),
            cwd=ROOT,
            env=dict(env or environment()),
            text=True,
            stdin=subprocess.DEVNULL if stdin is None else stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self._collector = threading.Thread(target=self._collect, daemon=True)
        self._collector.start()

    def _collect(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._lines.append(line.rstrip("\n"))

    @property
    def log(self) -> list[str]:
        """Lines of stderr so far."""
        return list(self._lines)

    def said(self, text: str) -> int:
        """How many log lines contain the text."""
        return sum(text in line for line in self.log)

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def wait(self, limit_s: float = PATIENCE_S) -> int:
        """The exit code."""
        code = self.process.wait(limit_s)
        self._collector.join(PATIENCE_S)
        return code

    def end(self) -> None:
        """Whatever its state: gone afterwards."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
            try:
                self.process.wait(10)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._collector.join(PATIENCE_S)
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()


class DaemonProgram(Program):
    """`servo-daemon run`, up as soon as its API answers."""

    def __init__(self, *words: str | Path, env: Mapping[str, str] | None = None, stdin: int | None = None) -> None:
        super().__init__("run", "--port", "0", *words, env=env, stdin=stdin)
        self.url = wait_for(self._address, "the daemon says where its API is")
        # Certificates here are of the tests' own making, and none is looked at over plain HTTP.
        self.client = httpx.Client(base_url=self.url, trust_env=False, timeout=PATIENCE_S, verify=False)

    def _address(self) -> str | None:
        for line in self.log:
            if match := _ADDRESS.search(line):
                return match[1]
        assert self.process.poll() is None, f"the daemon ended with {self.process.returncode}: {self.log}"
        return None

    def get(self, path: str) -> Any:
        """A document of the API."""
        answer = self.client.get(f"/api/v1{path}")
        assert answer.headers["content-type"].split(";")[0] in ("application/json", "application/problem+json")
        return answer.json()

    def estimates(self, drive: str = "axis1") -> dict[str, Any]:
        return self.get(f"/drives/{drive}/estimates")  # type: ignore[no-any-return]

    def events(self, drive: str = "axis1") -> list[str]:
        """Kinds of events of this run, oldest first; the store has those of earlier ones, too."""
        started = self.get("/health")["started"]
        return [e["kind"] for e in self.get(f"/drives/{drive}/events?since={started}")["events"]]

    def foreground_events(self, drive: str = "axis1") -> list[str]:
        """Those that follow from what happens to the drive: an RF+GRNN model is trained or loaded in a thread of its
        own, and says so before or after anything that a test does."""
        return [kind for kind in self.events(drive) if kind not in ("model_learned", "refreshed")]

    def until(
        self,
        ok: Callable[[dict[str, Any]], object],
        what: str,
        drive: str = "axis1",
        limit_s: float = PATIENCE_S,
        every_s: float = 0.02,
    ) -> dict[str, Any]:
        """The first estimates document for which `ok`."""
        last: dict[str, Any] = {}

        def probe() -> dict[str, Any] | None:
            last.clear()
            last.update(self.estimates(drive))
            return dict(last) if ok(last) else None

        try:
            return wait_for(probe, what, limit_s, every_s)
        except AssertionError as error:
            raise AssertionError(f"{error}\nlast: {last}\nlog: {self.log}") from None

    def end(self) -> None:
        if hasattr(self, "client"):
            self.client.close()
        super().end()

    def stop(self, number: signal.Signals = signal.SIGTERM) -> float:
        """Tell it to stop and see that it does, cleanly. Returns how long it took, s."""
        began = time.monotonic()
        self.send(number)
        code = self.wait()
        took = time.monotonic() - began
        assert code == 0, self.log
        assert self.log[-1].endswith("stopped"), self.log
        assert not [line for line in self.log if "Traceback" in line], self.log
        return took


@contextlib.contextmanager
def daemon(
    *words: str | Path, env: Mapping[str, str] | None = None, stdin: int | None = None
) -> Iterator[DaemonProgram]:
    """A running daemon; its log is shown when the test fails in it."""
    program: DaemonProgram | None = None
    try:
        program = DaemonProgram(*words, env=env, stdin=stdin)
        yield program
    finally:
        if program is not None:
            program.end()
            print("\n".join(program.log))  # pytest shows it with a failure


@contextlib.contextmanager
def sim_drive(wire: str, link: Path, *words: str) -> Iterator[Program]:
    """`servo-daemon sim-drive`, up as soon as its link is there.

    Args:
        wire: "serial" or "slcan".
    """
    program = Program("sim-drive", f"--{wire}", link, *words)
    try:
        wait_for(link.exists, f"{link} appears")
        yield program
    finally:
        program.end()


def write_config(path: Path, *drives: str, head: str = "") -> Path:
    """A configuration file of [[drive]] tables given as TOML text."""
    path.write_text(head + "".join(f"[[drive]]\n{drive}\n" for drive in drives), encoding="utf-8")
    return path


def nominal_table() -> str:
    """`[drive.nominal]` of the motor of the demonstration: a good third off. Without a learned model: one that somebody
    has trained on this machine must not take part unasked."""
    from servo_daemon.simulate import DEFAULT_NOMINAL

    values = "".join(f"{name} = {value!r}\n" for name, value in DEFAULT_NOMINAL.items())
    return f"[drive.estimation]\nrefresh = false\n[drive.nominal]\n{values}"


def statuses(document: Mapping[str, Any]) -> set[str]:
    return {p["status"] for p in document["parameters"].values()}


def all_tracking(document: Mapping[str, Any]) -> bool:
    return statuses(document) == {"tracking"}


def assert_close(document: Mapping[str, Any], truth: Mapping[str, float], relative: float = 0.05) -> None:
    """R, K, J, B within `relative` of the truth, L within 10 % (issue 2)."""
    for name in LINEAR:
        value = document["parameters"][name]["value"]
        limit = 0.10 if name == "L" else relative
        assert abs(value / truth[name] - 1) < limit, f"{name} = {value}, true {truth[name]}"


class Fetched:
    """A simulated drive that ends after so many samples: everything it has to say can be counted.

    Attributes:
        taken: samples handed out.
    """

    def __init__(self, drive: SimulatedDrive, limit: int) -> None:
        self._drive, self._limit, self.taken = drive, limit, 0
        self.info = drive.info

    def next_block(self, n: int) -> Any:
        from servo_daemon.errors import EndOfStreamError

        n = min(n, self._limit - self.taken)
        if n < 1:
            raise EndOfStreamError("that was all")
        self.taken += n
        return self._drive.next_block(n)
