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
        ("servo_daemon/estimators/ekf.py", "servo_daemon/estimators/ekf_model.py", "servo_daemon/estimators/noise.py"),
        (
            "tests/unit/test_ekf.py",
            "tests/unit/test_noise.py",
            "tests/unit/test_filled.py",
            "tests/recovery/test_tracking.py",
            "tests/recovery/test_tracking_noise.py",
        ),
    ),
    "regression": Group(
        (
            "servo_daemon/estimators/*rls.py",
            "servo_daemon/estimators/rls_fit.py",
            "servo_daemon/estimators/linear_regression.py",
            "servo_daemon/estimators/regression_terms.py",
        ),
        (
            "tests/unit/test_rls*.py",
            "tests/unit/test_linear_regression.py",
            "tests/unit/test_regression_terms.py",
            "tests/unit/test_excitation_fusion.py",
            "tests/recovery/test_tracking.py",
        ),
    ),
    "validity": Group(
        (
            "servo_daemon/estimators/parameter_judge.py",
            "servo_daemon/estimators/fusion.py",
            "servo_daemon/estimators/last_known.py",
            "servo_daemon/estimators/closure.py",
            "servo_daemon/estimators/excitation.py",
        ),
        (
            "tests/unit/test_excitation_fusion.py",
            "tests/unit/test_two_witnesses.py",
            "tests/unit/test_closure.py",
            "tests/unit/test_balances.py",
            "tests/recovery/test_tracking.py",
            "tests/recovery/test_tracking_honesty.py",
        ),
    ),
    "gain": Group(
        (
            "servo_daemon/diagnosis/noise_floor.py",
            "servo_daemon/diagnosis/compare.py",
            "servo_daemon/diagnosis/scored.py",
        ),
        (
            "tests/unit/test_diagnosis_*.py",
            "tests/unit/test_diagnose_document.py",
            "tests/recovery/test_hidden.py",
        ),
    ),
    "refresh": Group(
        (
            "servo_daemon/learning/refresh.py",
            "servo_daemon/learning/proof.py",
            "servo_daemon/learning/recent.py",
            "servo_daemon/service/refresher.py",
        ),
        ("tests/unit/test_recent_windows.py", "tests/unit/test_refresh.py", "tests/unit/test_refresher.py"),
    ),
}


def found(root: Path, patterns: tuple[str, ...]) -> list[str]:
    """Files that are there, in the order of the patterns, as paths from the top.

    Raises:
        FileNotFoundError: a pattern fits nothing.
    """
    out: list[str] = []
    for pattern in patterns:
        paths = sorted(str(p.relative_to(root)) for p in root.glob(pattern))
        if not paths:
            raise FileNotFoundError(pattern)
        out += [p for p in paths if p not in out]
    return out
