"""Free runs of few samples: CasADi's virtual machine has run them long before a compiler is done, with the same bits
(tests/unit/plant/test_plant_compiled.py)."""

from __future__ import annotations

from functools import cache

import pytest

from servo_daemon.identification.output_error.problem import rollout
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.compiled import SampleLoop


@cache
def _loop(plant: PlantModel, channels: tuple[str, ...], sensitivities: bool) -> SampleLoop:
    step = rollout._sensitivity_step if sensitivities else rollout._plain_step
    return SampleLoop(step(plant, channels), compiled=False)


def run_uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """For the rest of a test no free run is compiled."""
    monkeypatch.setattr(rollout, "_loop", _loop)
