"""The exported estimator on the processor that it is for: a Cortex-M4F in QEMU, over a recorded capture."""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from tests.unit.export.firmware import (
    CURRENT_STD,
    NAMES,
    POSITION_STD,
    RAD_PER_COUNT,
    RATE_HZ,
    START_STD,
    TICK,
    VOLTAGE_STD,
    Recorded,
    daemons_estimates,
    exported,
    recorded,
    wrapped,
)  # fmt: skip
from tests.unit.export.motor import VALUES

#: Issue 32, for 7 states: RAM, and time at 168 MHz by instructions.
MOST_RAM, MOST_US, CLOCK_MHZ = 8192, 20.0, 168.0
WITHIN_STD = 0.1
_CALIBRATION = 200_000  # instructions that main.c times
_TARGET = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")
_TRACKING = 2


def _array(name: str, kind: str, values: Iterable[str]) -> str:
    return f"static const {kind} {name}[] = {{{', '.join(values)}}};\n"


def _float(value: float) -> str:
    return f"{float(value):.9e}f"


def _capture_header(capture: Recorded) -> str:
    noise = ", ".join(map(_float, (VOLTAGE_STD, CURRENT_STD, POSITION_STD, 0.0)))
    return (
        f"#define SAMPLES {len(capture.voltage)}u\n#define TICK {TICK}u\n#define PERIOD {_float(1.0 / RATE_HZ)}\n"
        f"static const servo_noise noise = {{{noise}, {{0}}}};\n"
        + _array("start", "float", (_float(VALUES[n][0]) for n in NAMES))
        + _array("start_std", "float", (_float(START_STD[n]) for n in NAMES))
        + _array("voltage", "float", map(_float, capture.voltage))
        + _array("current", "float", map(_float, capture.current))
        + _array("counts", "int32_t", (f"(int32_t)({wrapped(c)}L)" for c in capture.counts))
    )


@pytest.mark.slow
@pytest.mark.system
def test_on_a_cortex_m4f_in_time_in_memory_and_as_the_daemon(program: Callable[..., str], tmp_path: Path) -> None:
    compiler, machine = program("arm-none-eabi-gcc"), program("qemu-system-arm")
    sources = Path(__file__).parent / "cortex"
    exported(tmp_path)
    capture = recorded(10.0)
    (tmp_path / "capture.h").write_text(_capture_header(capture), encoding="utf-8")
    image = str(tmp_path / "firmware.elf")
    build = [
        compiler, "-std=c99", "-Wall", "-Wextra", "-Werror", "-O3", *_TARGET, "-nostartfiles", "--specs=nosys.specs",
        f"-DSERVO_RAD_PER_COUNT={RAD_PER_COUNT:.9g}f", f"-I{tmp_path}", "-T", str(sources / "link.ld"),
        str(sources / "main.c"), str(tmp_path / "estimator.c"), "-o", image, "-lm",
    ]  # fmt: skip
    subprocess.run(build, check=True)
    board = [machine, "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "none",
             "-semihosting-config", "enable=on,target=native", "-icount", "shift=0", "-kernel", image]  # fmt: skip
    done = subprocess.run(board, capture_output=True, text=True, timeout=100, check=False)
    lines = [line.split() for line in (done.stdout + done.stderr).splitlines() if line]
    assert lines[-1][0] == "sizes", done.stderr
    size, stack, spent, ticks, status = (int(word, 16) for word in lines[-1][1:])
    assert status == _TRACKING

    rows = np.array([[struct.unpack(">f", bytes.fromhex(word))[0] for word in line] for line in lines[:-1]])
    expected, relative = daemons_estimates(capture)
    away = np.abs(np.log(rows[:, 0::2] / expected)) / relative
    instructions = spent / ticks * _CALIBRATION / len(capture.voltage)
    print(f"{size} + {stack} bytes, {instructions:.0f} instructions a sample, {away.max():.3f} std from the daemon")
    assert np.all(away < WITHIN_STD), away.max(axis=0)
    assert f"Memory: {size} bytes" in (tmp_path / "estimator.c").read_text(encoding="utf-8")
    assert size + stack < MOST_RAM, (size, stack)
    assert instructions / CLOCK_MHZ < MOST_US, instructions
