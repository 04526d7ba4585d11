"""`fit` of a drive whose current is behind its angle, by a filter that is known; and of one that tells no voltage."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.commands.fit.command import add_arguments
from servo_daemon.commands.fit.inputs import gather
from servo_daemon.identification.output_error import FittedParameter
from servo_daemon.identification.winding import joined_parameters

R, K, J, B = 0.5, 0.1, 0.035, 0.02
LATE_S = 4e-4
T = np.arange(0.0, 4.0, 2e-3)
#: Two sines of the speed, rad/s and rad/s.
SINES = ((8.0, 11.0), (3.0, 31.0))


def capture(path: Path) -> None:
    """A wheel; its current, of some noise, is that of a moment ago."""
    theta = sum(-a / w * np.cos(w * T) for a, w in SINES)
    speed = sum(a * np.sin(w * T) for a, w in SINES)

    def current(t: np.ndarray) -> np.ndarray:
        return sum(a * (J * w * np.cos(w * t) + B * np.sin(w * t)) for a, w in SINES) / K

    noise = np.random.default_rng(1).normal(0.0, 1.0, (3, len(T)))
    voltage = R * current(T) + K * speed + 1e-3 * noise[0]
    columns = (T, voltage, current(T - LATE_S) + 1e-3 * noise[1], theta + 1e-7 * noise[2])
    rows = "\n".join(",".join(f"{x:.9g}" for x in row) for row in np.column_stack(columns))
    head = f"# voltage: instant\n# current_late_s: {LATE_S}\ntime_s,voltage_V,current_A,position_rad\n"
    path.write_text(head + rows + "\n", encoding="utf-8")


def test_b_is_not_what_the_filter_feigns_and_says_how_far_it_is_open(tmp_path: Path) -> None:
    path = tmp_path / "wheel.csv"
    capture(path)
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    inputs = gather(parser.parse_args([str(path)]), [path])
    assert inputs.winding is not None and inputs.captures[0].position_rad is not None
    position, current = inputs.captures[0].position_rad, inputs.captures[0].current_A
    # The balance of torques over every sample, by differences: of the current's own moment.
    speed, torque = np.gradient(position, T), K * current
    columns = np.column_stack([np.gradient(speed, T), speed])[5:-5]
    fitted = dict(zip("JB", np.linalg.lstsq(columns, torque[5:-5], rcond=None)[0], strict=True))
    squares = [sum((a * w**k) ** 2 for a, w in SINES) for k in (0, 1)]
    feigned = J * LATE_S * squares[1] / squares[0]
    assert feigned > 0.15 * B and abs(fitted["B"] - B) < 0.2 * feigned

    rows = {n: FittedParameter(v, 1e-5, "kg·m²" if n == "J" else "N·m·s/rad", "estimated", at_bound=False)
            for n, v in fitted.items()}  # fmt: skip
    std = joined_parameters(rows, inputs.winding)["B"].std
    assert std == pytest.approx(J * np.hypot(5e-5, 0.15 * LATE_S) * squares[1] / squares[0], rel=0.15)


def test_a_drive_without_a_voltage_has_no_balance_of_it(tmp_path: Path) -> None:
    """As `record` writes an ODrive's: its signals have a meaning, and no voltage is among them."""
    path = tmp_path / "odrive.csv"
    rows = "\n".join(f"{t:.3f},{np.sin(t):.6f},{np.cos(t):.6f}" for t in T[:100])
    path.write_text(f"# voltage: instant\n# convention: dq\ntime_s,current_A,position_rad\n{rows}\n", encoding="utf-8")
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    inputs = gather(parser.parse_args([str(path), "--fix", "K=0.1"]), [path])
    assert inputs.winding is None and not any("winding" in note for note in inputs.notes)
