"""Puts one fault after another into a copy of the tree and runs the tests that should notice."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.mutants.groups import found

#: Nothing of it belongs to what is tested.
_LEFT_OUT = (".git", ".venv", "build", "dist", "*.egg-info", "__pycache__", ".*_cache", ".hypothesis", "*.jsonl")
#: A mutant may loop for ever: it is caught after so many times what the tests take without it, and no sooner than this.
_PATIENCE, _LEAST_S = 5.0, 120.0


@dataclass(frozen=True, slots=True)
class Fault:
    """What is done to one file.

    Attributes:
        group, title: for the table.
        file: from the top of the tree.
        text: the whole file with the fault; None: the fault is stale.
        tests: files, from the top.
    """

    group: str
    title: str
    file: str
    text: str | None
    tests: tuple[str, ...]

    @property
    def key(self) -> str:
        return f"{self.group}: {self.file}: {self.title}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of one fault: "killed", "survived" or "stale"; the test that failed first, or ""."""

    group: str
    title: str
    file: str
    outcome: str
    by: str
    seconds: float


class Workshop:
    """A copy of the tree in which faults are put and taken away again.

    Args:
        root: the tree.
        folder: where the copy is made; must not exist.
        markers: pytest's -m, which tests are run.
    """

    def __init__(self, root: Path, folder: Path, markers: str = "not slow") -> None:
        self._root, self._folder, self._markers = root, folder, markers
        self._usual_s: dict[tuple[str, ...], float] = {}
        shutil.copytree(root, folder, ignore=shutil.ignore_patterns(*_LEFT_OUT))

    def judge(self, fault: Fault) -> Outcome:
        """Run its tests with the fault in place.

        Raises:
            RuntimeError: they fail without it, too.
        """
        if fault.text is None:
            return Outcome(fault.group, fault.title, fault.file, "stale", "", 0.0)
        if fault.tests not in self._usual_s:
            begun = time.monotonic()
            if failed := self._failing(fault.tests, None):
                raise RuntimeError(f"these tests fail without any fault: {failed}")
            self._usual_s[fault.tests] = time.monotonic() - begun
        path = self._folder / fault.file
        whole, begun = path.read_bytes(), time.monotonic()
        try:
            self._write(path, fault.text.encode())
            failed = self._failing(fault.tests, max(_LEAST_S, _PATIENCE * self._usual_s[fault.tests]))
        finally:
            self._write(path, whole)
        outcome = "killed" if failed else "survived"
        return Outcome(fault.group, fault.title, fault.file, outcome, failed, time.monotonic() - begun)

    def _write(self, path: Path, text: bytes) -> None:
        """What was compiled of it goes, too: its date may be the same to the second, and its size."""
        path.write_bytes(text)
        Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)

    def _failing(self, tests: Sequence[str], patience_s: float | None) -> str:
        """The first test that fails, "" if none does."""
        # One after the other, as they are listed: the likeliest to notice come first.
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", self._markers]
        # pytest's own limit is for a machine that does nothing else.
        command += ["-o", "timeout=0", "-p", "no:randomly", "-p", "no:cacheprovider", "--no-header", "--tb=no", *tests]
        environment = {
            **os.environ,
            "PYTHONPATH": str(self._folder),
            "OMP_NUM_THREADS": "1",
            "SERVO_DATA": os.environ.get("SERVO_DATA", str((self._root / "../shared/data").resolve())),
        }
        try:
            done = subprocess.run(
                command,
                cwd=self._folder,
                env=environment,
                capture_output=True,
                text=True,
                timeout=patience_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return "none of them comes to an end"
        if done.returncode in (0, 5):  # 5: there is none to run
            return ""
        named = [line.split(" ", 2)[1] for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return named[0] if named else (done.stdout + done.stderr).strip()[-200:]


def tests_of(root: Path, patterns: tuple[str, ...]) -> tuple[str, ...]:
    """Files of tests; see `found`."""
    return tuple(found(root, patterns))
