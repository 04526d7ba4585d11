"""Which files are sampled, and which fast tests each sample is held against."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Group:
    """A part of the program.

    Attributes:
        files, tests: patterns from the top of the tree; the tests most likely to notice come first.
    """

    files: tuple[str, ...]
    tests: tuple[str, ...]


GROUPS: Mapping[str, Group] = {
    "kalman": Group(
        (
            "servo_daemon/kalman/ekf.py",
            "servo_daemon/kalman/moments.py",
            "servo_daemon/kalman/model.py",
            "servo_daemon/kalman/measurement.py",
            "servo_daemon/tracking/noise/levels.py",
        ),
        (
            "tests/unit/kalman/test_ekf.py",
            "tests/unit/tracking/test_noise.py",
            "tests/unit/conditioning/test_filled.py",
            "tests/recovery/test_tracking.py",
            "tests/recovery/test_tracking_noise.py",
        ),
    ),
    "regression": Group(
        (
            "servo_daemon/regression/*rls.py",
            "servo_daemon/regression/rls_fit.py",
            "servo_daemon/regression/linear_regression.py",
            "servo_daemon/regression/columns/terms.py",
        ),
        (
            "tests/unit/regression/test_rls*.py",
            "tests/unit/regression/test_linear_regression.py",
            "tests/unit/regression/columns/test_regression_terms.py",
            "tests/unit/tracking/test_excitation_fusion.py",
            "tests/recovery/test_tracking.py",
        ),
    ),
    "validity": Group(
        (
            "servo_daemon/tracking/validity/gates.py",
            "servo_daemon/tracking/validity/mismatch.py",
            "servo_daemon/tracking/validity/confirmation.py",
            "servo_daemon/tracking/validity/fusion.py",
            "servo_daemon/tracking/validity/last_known.py",
            "servo_daemon/regression/residual_analysis.py",
            "servo_daemon/tracking/validity/excitation.py",
        ),
        (
            "tests/unit/tracking/test_excitation_fusion.py",
            "tests/unit/tracking/test_gates.py",
            "tests/unit/pipeline/test_two_witnesses.py",
            "tests/unit/regression/test_residual_analysis.py",
            "tests/unit/regression/test_balances.py",
            "tests/recovery/test_tracking.py",
            "tests/recovery/test_tracking_honesty.py",
        ),
    ),
    "gain": Group(
        (
            "servo_daemon/diagnosis/trial/noise_floor.py",
            "servo_daemon/diagnosis/trial/compare.py",
            "servo_daemon/diagnosis/trial/scored.py",
        ),
        (
            "tests/unit/diagnosis/test_*.py",
            "tests/unit/commands/test_diagnose_document.py",
            "tests/recovery/test_hidden.py",
        ),
    ),
    "refresh": Group(
        (
            "servo_daemon/learning/refresh/refresh.py",
            "servo_daemon/learning/refresh/champion_challenger.py",
            "servo_daemon/learning/refresh/recent.py",
            "servo_daemon/pipeline/refresher.py",
        ),
        (
            "tests/unit/learning/test_recent_windows.py",
            "tests/unit/learning/test_refresh.py",
            "tests/unit/pipeline/test_refresher.py",
        ),
    ),
}


def found(root: Path, patterns: tuple[str, ...]) -> list[str]:
    """Files that are there, in the order of the patterns, as paths from the top; `file::test` names one test of a file.

    Raises:
        FileNotFoundError: a pattern fits nothing.
    """
    out: list[str] = []
    for pattern in patterns:
        file, colons, test = pattern.partition("::")
        paths = [f"{p}{colons}{test}" for p in sorted(str(p.relative_to(root)) for p in root.glob(file))]
        if not paths:
            raise FileNotFoundError(pattern)
        out += [p for p in paths if p not in out]
    return out
