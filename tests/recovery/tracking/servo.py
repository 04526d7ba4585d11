"""The default simulated servo, `run`'s own, through the daemon's pipeline, without a file between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from servo_daemon.config import DriveConfig
from servo_daemon.plant.effects.winding_heating import ALPHA_COPPER_1_K
from servo_daemon.samples import F64, SampleBlock
from servo_daemon.simulate import DEFAULT_J_M, SimulatedDrive, make_settings
from tests.recovery.generator import EffectValues
from tests.recovery.tracking.voices import Heard, listened

#: What is published of it.
SHOWN = ("R", "L", "K", "J", "B", "J_d")
#: Of a block: 0.1 s, so that events have a time.
_SAMPLES = 100


def servo_heard(
    ageing: Sequence[str],
    nominal: Mapping[str, float],
    seconds: float,
    seed: int,
    effects: Mapping[str, EffectValues] | None = None,
) -> tuple[Heard, F64]:
    """What is said of it, and the truth at each tick, shape (m, SHOWN); R is the hot winding's.

    Args:
        ageing: as `simulate --ageing` takes it.
        nominal: datasheet values, J_m among them.
        effects: hidden ones with their parameters; the daemon is told of none.
    """
    settings = make_settings(J_m=DEFAULT_J_M, ageing=ageing, effects=effects or {}, seed=seed)
    drive = SimulatedDrive(settings)
    warmth: list[tuple[float, float]] = []

    def blocks() -> Iterator[SampleBlock]:
        for _ in range(round(seconds * settings.rate_hz) // _SAMPLES):
            block = drive.next_block(_SAMPLES)
            warmth.append((float(block.time_s[-1]), drive.true_state().get("winding_rise_K", 0.0)))
            yield block

    heard = listened(DriveConfig(nominal=dict(nominal)), drive.info, blocks())
    assert heard.names == SHOWN
    values = dict(zip(settings.model.parameter_names, settings.ageing.values(heard.time_s).T, strict=True))
    values["J_d"] = values["J"] - DEFAULT_J_M
    values["R"] = values["R"] * (1 + ALPHA_COPPER_1_K * np.interp(heard.time_s, *np.array(warmth).T))
    return heard, np.column_stack([values[name] for name in SHOWN])
