"""One EKF step (8 states, 2 measurements) against filterpy's ExtendedKalmanFilter on the same model, in one run.

Rivals, same samples, same start: filterpy driven sample by sample with the plant's Jacobians from CasADi (the daemon's
own readable engine), and ours in CasADi's virtual machine, as on a computer without a C compiler.

    .venv/bin/python benchmarks/ekf_step.py
"""

from __future__ import annotations

import time

import numpy as np

from servo_daemon.kalman.filterpy_ekf import FilterpyLoop
from servo_daemon.kalman.layout import EkfLayout
from servo_daemon.kalman.model import INSTRUMENT_S, build_ekf_step
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.simulate import SimulatedDrive, make_settings

SECONDS, RIVAL_SAMPLES, REPEATS = 60, 3000, 5
CHANNELS = ("current_A", "position_rad")


def rows(layout: EkfLayout, seconds: int) -> np.ndarray:
    """Samples of the simulated motor as the filter takes them."""
    block = SimulatedDrive(make_settings(seed=1)).next_block(1000 * seconds)
    out = np.ones((len(block), layout.n_sample))
    out[:, 0] = block.time_s - block.time_s[0]
    out[:, 1] = np.diff(block.time_s, prepend=block.time_s[0])
    out[:, 2], out[:, 3], out[:, 4], out[:, 7] = block.voltage_V, 0.0, block.current_A, block.position_rad
    out[:, -1] = 0.0
    return out


def start(layout: EkfLayout) -> tuple[np.ndarray, np.ndarray]:
    """State and constants of a filter 20 % off."""
    state, constants = np.zeros(layout.n_state), np.ones(layout.n_constants)
    state[layout.q] = np.log([1.2 * p.nominal for p in layout.plant.parameters])
    P = np.diag([1.0] * layout.n_z)
    tri = [(r, c) for c in range(layout.n_z) for r in range(c, layout.n_z)]
    state[layout.tri] = [P[r, c] for r, c in tri]
    constants[0], constants[1] = 1e-4, 1e-9
    constants[layout.walk], constants[layout.active] = 1e-7, 1.0
    constants[layout.r], constants[-1] = [2e-3, 1e-8], INSTRUMENT_S
    return state, constants


def best_us(run, samples: np.ndarray, layout: EkfLayout, repeats: int) -> tuple[float, np.ndarray]:
    """Shortest time per sample, µs, and the final state."""
    shortest = np.inf
    for _ in range(repeats):
        state, constants = start(layout)
        began = time.perf_counter()
        run(state, constants, samples)
        shortest = min(shortest, time.perf_counter() - began)
    return 1e6 * shortest / len(samples), state


def main() -> None:
    layout, function = build_ekf_step(build_plant(), CHANNELS)
    samples = rows(layout, SECONDS)
    short = np.ascontiguousarray(samples[:RIVAL_SAMPLES])
    compiled, machine = SampleLoop(function), SampleLoop(function, compiled=False)
    ours, _ = best_us(compiled.run, samples, layout, REPEATS)
    vm, _ = best_us(machine.run, samples, layout, REPEATS)
    rival, rival_state = best_us(FilterpyLoop(layout.plant, CHANNELS).run, short, layout, 2)
    _, our_state = best_us(compiled.run, short, layout, 1)
    difference = np.abs(our_state[layout.z] - rival_state[layout.z]).max()
    print(f"{layout.n_z} states, {len(CHANNELS)} measurements, µs a sample")
    print(f"  ours, {compiled.backend:<24} {ours:10.2f}")
    print(f"  ours, CasADi's virtual machine {vm:7.2f}")
    print(f"  filterpy {rival:29.2f}")
    print(f"  ratio filterpy : ours {rival / ours:13.0f} x   (virtual machine {rival / vm:.0f} x)")
    print(f"  largest difference of the final states after {RIVAL_SAMPLES} samples: {difference:.1e}")


if __name__ == "__main__":
    main()
