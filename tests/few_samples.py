"""Free runs of few samples: CasADi's virtual machine has run them long before a compiler is done, with the same bits
(tests/unit/plant/test_plant_compiled.py)."""

from __future__ import annotations

from functools import cache

import pytest

from servo_daemon.identification.output_error.problem import rollout


def run_uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """For the rest of a test no model is compiled; those that are known already are not asked for."""
    monkeypatch.setenv("SERVO_DAEMON_CC", "")
    monkeypatch.setattr(rollout, "_loop", cache(rollout._loop.__wrapped__))
