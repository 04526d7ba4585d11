"""Fixtures of the exports' tests."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from servo_daemon.cli import main
from servo_daemon.commands.export.source import from_document
from servo_daemon.export.model import ExportedModel
from tests.unit.export.motor import Exporting


@pytest.fixture
def model_of(tmp_path: Path) -> Callable[..., ExportedModel]:
    """An exported model from a document."""

    def read(content: dict[str, Any]) -> ExportedModel:
        path = tmp_path / "fit.json"
        path.write_text(json.dumps(content), encoding="utf-8")
        return from_document(path, None)

    return read


@pytest.fixture
def export(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Exporting:
    """`servo-daemon export` of a document."""

    def run(content: dict[str, Any], *words: str) -> tuple[int, str]:
        path = tmp_path / "fit.json"
        path.write_text(json.dumps(content), encoding="utf-8")
        code = main(["export", str(path), *words])
        return code, capsys.readouterr().err

    return run
