"""Calls a command in this process, as its user would: exit code, stdout, stderr."""

from __future__ import annotations

import contextlib
import io
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from servo_daemon import cli


@dataclass(frozen=True)
class Result:
    code: int
    out: str
    err: str

    @property
    def document(self) -> Any:
        """The one JSON document on stdout."""
        assert self.code == 0, self.err
        return json.loads(self.out)


def run_command(*words: str | Path) -> Result:
    """`servo-daemon WORDS…` without this machine's overrides."""
    bare = {k: v for k, v in os.environ.items() if not k.startswith("SERVO_DAEMON_")}
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.dict(os.environ, bare, clear=True),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            code = cli.main([str(w) for w in words])
        except SystemExit as stop:
            code = int(stop.code or 0)
    return Result(code, out.getvalue(), err.getvalue())
