"""`diagnose` of a motor with dry friction, as several tests look at it; called once a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.command_line import Result, run_command

#: What is hidden in the capture, N·m.
TC = 0.3


@dataclass(frozen=True)
class Run:
    """One call with everything, what it read and where it wrote."""

    result: Result
    capture: Path
    folder: Path

    @property
    def document(self) -> Any:
        return self.result.document


def dry_friction(once: Callable[[str, Callable[[], Any]], Any], run_folder: Path) -> Run:
    """Of 6 s of the simulated paper's motor; `once` and `run_folder`: the fixtures."""

    def diagnosed() -> Run:
        capture, folder = run_folder / "dry.csv", run_folder / "deep" / "folder"
        words = ("--seconds", "6", "--seed", "4", "--effect", f"coulomb_friction:Tc={TC}")
        assert run_command("simulate", "--out", capture, *words).code == 0
        words = ("--out", folder, "--json", "--progress-json", "--validate", capture, "--adapt", "0.3")
        return Run(run_command("diagnose", capture, *words), capture, folder)

    run: Run = once("dry friction", diagnosed)
    return run
