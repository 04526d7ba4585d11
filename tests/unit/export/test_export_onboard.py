"""The firmware's example with an exported estimator, over the own wire, until it is published."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.base import OnboardEstimates
from drivers.serial.decoder import BinaryDecoder
from drivers.serial.frame import encode_frame
from servo_daemon.pipeline.views import with_onboard
from tests.fake_daemon import make_estimate
from tests.unit.export.firmware import RAD_PER_COUNT, exported

#: The motor in deploy/firmware/example_estimator.c; its Euler steps leave some tenths of a percent.
TRUE = {"R": 1.2, "K": 0.057, "J": 5.5e-5}


def built(folder: Path, compiler: str, firmware: Path, *effects: str) -> bytes:
    """What the example sends with the estimator of this model."""
    exported(folder, *effects)
    command = [compiler, "-std=c99", "-Wall", "-Wextra", "-Werror", "-O2", f"-I{folder}", f"-I{firmware}",
               f"-DSERVO_RAD_PER_COUNT={RAD_PER_COUNT:.9g}f", str(firmware / "example_estimator.c"),
               str(folder / "estimator.c"), "-o", str(folder / "example"), "-lm"]  # fmt: skip
    subprocess.run(command, check=True)
    return subprocess.run([str(folder / "example")], capture_output=True, check=True).stdout


@pytest.fixture(scope="module")
def line(program: Callable[..., str], repo_root: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """What the example sends."""
    return built(tmp_path_factory.mktemp("firmware"), program("gcc", "cc"), repo_root / "deploy" / "firmware")


def test_the_example_takes_a_model_with_friction(program: Callable[..., str], repo_root: Path, tmp_path: Path) -> None:
    decoder = BinaryDecoder()
    decoder.feed(built(tmp_path, program("gcc", "cc"), repo_root / "deploy" / "firmware", "coulomb_friction"), 0.0)
    assert decoder.onboard is not None
    assert list(decoder.onboard.values) == ["R", "K", "J", "B", "Tc"]


def test_what_the_drive_estimates_comes_over_the_wire(line: bytes) -> None:
    decoder = BinaryDecoder()
    block = decoder.feed(line, 123.0)
    assert block is not None and len(block) == 10_000
    told = decoder.onboard
    assert told is not None
    assert (told.status, told.heard_s, list(told.values)) == ("tracking", 123.0, ["R", "K", "J", "B"])
    for name, true in TRUE.items():
        assert told.values[name][0] == pytest.approx(true, rel=0.02)
    assert (decoder.counters.unknown_frames, decoder.counters.framing_errors) == (0, 0)


def test_a_frame_that_is_none_is_counted(line: bytes) -> None:
    decoder = BinaryDecoder()
    decoder.feed(line[:400], 0.0)
    head = bytes([3, 7, 1, 1, 0, 0, 0, 0])
    for payload in (head, head + bytes([9]) + bytes(16), head + bytes([2]) + bytes(15)):
        decoder.feed(encode_frame(payload))
    assert decoder.onboard is None
    assert decoder.counters.framing_errors == 3
    nan = np.array([np.nan, 1.0], dtype="<f4").tobytes()
    decoder.feed(encode_frame(head + bytes([2]) + b"R".ljust(8, b"\0") + nan))
    assert decoder.onboard is not None and decoder.onboard.values == {}


def test_it_is_published_beside_the_daemons_own_while_it_is_fresh() -> None:
    estimate = make_estimate()
    told = OnboardEstimates("tracking", {"R": (1.2, 0.01), "Tx": (1.0, None)}, heard_s=5.0)
    shown = with_onboard(estimate, told, 6.0)
    assert shown is not None
    assert shown.estimators["onboard"].parameters == {"R": (1.2, 0.01)}
    assert shown.estimators["onboard"].detail == {"status": "tracking", "age_s": 1.0}
    assert shown.parameters == estimate.parameters
    starting = with_onboard(estimate, OnboardEstimates("starting", told.values, 5.0), 6.0)
    assert starting is not None and starting.estimators["onboard"].parameters == {"R": (None, None)}
    assert with_onboard(estimate, told, 20.0) == estimate
