"""A recorded capture, the daemon's filter over it, and the exported estimator compiled and run over it."""

from __future__ import annotations

import ctypes
import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servo_daemon.cli import main
from servo_daemon.kalman.ekf import Ekf
from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.kalman.records import NoiseLevels
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.linear import linear_step
from servo_daemon.samples import F64
from tests.unit.export.motor import VALUES, document

RATE_HZ, COUNTS_PER_REV = 1000.0, 4096
H = 1.0 / RATE_HZ
RAD_PER_COUNT = 2.0 * np.pi / COUNTS_PER_REV
VOLTAGE_STD, CURRENT_STD, POSITION_STD = 0.02, 0.02, RAD_PER_COUNT / np.sqrt(12.0)
#: Of the start: relative; and how far from it the motor is.
START_STD = {"R": 0.1, "K": 0.1, "J": 0.15, "B": 0.3, "Tc": 0.3}
TRUE = {"R": 1.18, "K": 0.0565, "J": 5.7e-5, "B": 4e-5, "L": 1e-3}
NAMES = tuple(START_STD)[:4]
TICK = 100


class Noise(ctypes.Structure):
    """servo_noise."""

    _fields_ = (("std", ctypes.c_float * 4), ("walk", ctypes.c_float * 8))


@dataclass(frozen=True)
class Recorded:
    """What a drive recorded: voltage held from each sample on, current, counts."""

    voltage: F64
    current: F64
    counts: F64


def recorded(seconds: float, seed: int = 3, Tc: float = 0.0) -> Recorded:
    """Random steps of the voltage, outliers of the current, a counter that passes the end of its 32 bits; dry friction
    so that it stops and never drives."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE_HZ)
    voltage = np.repeat(rng.uniform(-6.0, 6.0, -(-n // 40)), 40)[:n]
    parts = 10 if Tc else 1  # dry friction turns round within a sample
    Ad, Bd = linear_step(TRUE, H / parts)
    x, rows = np.zeros(3), []
    for v in voltage:
        rows.append(x)
        held = v + VOLTAGE_STD * rng.standard_normal()
        for _ in range(parts):
            x = Ad @ x + Bd[:, 0] * held
            x = x + Bd[:, 1] * np.clip(-x[1] / Bd[1, 1], -Tc, Tc)
    states = np.array(rows)
    current = states[:, 0] + CURRENT_STD * rng.standard_normal(n)
    current[rng.integers(200, n, 5)] += 20.0
    counts = np.round(states[:, 2] / RAD_PER_COUNT) + 2_147_483_000
    return Recorded(voltage, current, counts)


def daemons_estimates(capture: Recorded, effects: tuple[str, ...] = ()) -> tuple[F64, F64]:
    """Parameters (ticks, n) and their relative std by the daemon's compiled filter, from the same start."""
    plant = build_plant(effects)
    names = NAMES + (("Tc",) if effects else ())
    ekf = Ekf(plant, ("current_A", "position_rad"))
    mean = np.log([VALUES[name][0] for name in (*names, "L")])
    var = np.array([*(START_STD[name] ** 2 for name in names), 1e-18])
    ekf.start(Gaussian((*names, "L"), mean, np.diag(var)))
    ekf.set_noise(NoiseLevels(VOLTAGE_STD**2, 0.0, (CURRENT_STD**2, POSITION_STD**2)))
    active = np.array([float(name != "L") for name in plant.parameter_names])
    ekf.set_active(active, np.zeros(len(active)))
    n = len(capture.voltage)
    position = (capture.counts - capture.counts[0]) * RAD_PER_COUNT
    ones = np.ones(n)
    rows = np.column_stack(
        [
            H * np.arange(n),
            H * ones,
            capture.voltage,
            0 * ones,
            capture.current,
            ones,
            ones,
            position,
            ones,
            ones,
            0 * ones,
        ]
    )
    index = [plant.parameter_names.index(name) for name in names]
    values, stds = [], []
    for k in range(0, n, TICK):
        ekf.update(np.ascontiguousarray(rows[k : k + TICK]))
        values.append(np.exp(ekf.coordinates[index]))
        stds.append(ekf.coordinate_std[index])
    return np.array(values), np.array(stds)


def exported(folder: Path, *effects: str) -> None:
    """`estimator.c` and its header for this motor."""
    content = document(*effects, names=("Tc",) if effects else (), gear=1.0)
    (folder / "fit.json").write_text(json.dumps(content), encoding="utf-8")
    words = ["--to", "c", "--rate-hz", str(RATE_HZ), "--out", str(folder / "estimator.c")]
    assert main(["export", str(folder / "fit.json"), *words]) == 0


def compiled(folder: Path, compiler: str) -> ctypes.CDLL:
    """The estimator as a library of this machine; a warning is an error."""
    warnings = ["-Wall", "-Wextra", "-Wpedantic", "-Wdouble-promotion", "-Werror"]
    command = [
        compiler,
        "-std=c99",
        "-O2",
        *warnings,
        f"-DSERVO_RAD_PER_COUNT={RAD_PER_COUNT:.9g}f",
        "-fPIC",
        "-shared",
    ]
    subprocess.run([*command, str(folder / "estimator.c"), "-o", str(folder / "e.so"), "-lm"], check=True)
    library = ctypes.CDLL(str(folder / "e.so"))
    library.servo_estimator_value.restype = library.servo_estimator_std.restype = ctypes.c_float
    library.servo_estimator_sample.argtypes = [ctypes.c_void_p, *[ctypes.c_float] * 3, ctypes.c_int32, ctypes.c_int]
    return library


class OnBoard:
    """The compiled estimator."""

    def __init__(self, library: ctypes.CDLL, first: float, *, friction: bool = False, unknown: bool = False) -> None:
        start = (*NAMES, "Tc") if friction else NAMES
        self.friction, self.library, self.memory = friction, library, ctypes.create_string_buffer(4096)
        noise = Noise((ctypes.c_float * 4)(VOLTAGE_STD, CURRENT_STD, POSITION_STD, 0.0))
        counts = ctypes.c_int32(wrapped(first))
        if unknown:
            library.servo_estimator_start_unknown(self.memory, ctypes.byref(noise), counts)
            return
        values = (ctypes.c_float * len(start))(*(VALUES[n][0] for n in start))
        stds = (ctypes.c_float * len(start))(*(START_STD[n] for n in start))
        library.servo_estimator_start_at(self.memory, ctypes.byref(noise), counts, values, stds)

    def run(self, capture: Recorded) -> tuple[F64, F64]:
        """Values and their std at every tick, (ticks, n) each."""
        n = 5 if self.friction else 4
        rows = []
        for k, (v, i, counts) in enumerate(zip(capture.voltage, capture.current, capture.counts, strict=True)):
            self.sample(v, i, counts)
            if (k + 1) % TICK == 0:
                rows.append(self.estimates(n))
        return np.array([r[0] for r in rows]), np.array([r[1] for r in rows])

    def sample(self, v: float, i: float, counts: float, valid: int = 3) -> None:
        self.library.servo_estimator_sample(self.memory, H, v, i, wrapped(counts), valid)

    def estimates(self, n: int = len(NAMES)) -> tuple[list[float], list[float]]:
        get, std = self.library.servo_estimator_value, self.library.servo_estimator_std
        return [get(self.memory, k) for k in range(n)], [std(self.memory, k) for k in range(n)]

    @property
    def status(self) -> int:
        return int(self.library.servo_estimator_status(self.memory))


def wrapped(counts: float) -> int:
    """As a counter of 32 bits has it."""
    return int((int(counts) + 2**31) % 2**32 - 2**31)
