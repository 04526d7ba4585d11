"""A report with one of everything, of the size of a real one; for the tests of the writer and to be looked at:

python -m tests.report_demo demo.html
"""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from servo_daemon.report import (
    Axis,
    Bar,
    Bars,
    CaptureFile,
    Code,
    Column,
    Equation,
    Items,
    Iterations,
    Line,
    Mark,
    Measured,
    Points,
    Provenance,
    Report,
    Scatter,
    Section,
    Span,
    Spectrum,
    Table,
    Text,
    TimeSeries,
    Verdict,
    write_report,
)
from servo_daemon.samples import F64

HOSTILE = '<img src=x onerror="alert(1)">&amp;\u2028</script><!-- \x00'
SPIKE_S = 37.123


def signals(seconds: float, rate_hz: float) -> dict[str, F64]:
    """A motor that follows a slow reversal with friction the model lacks: time and channels, shape (n,) each."""
    rng = np.random.default_rng(7)
    t = np.arange(int(seconds * rate_hz)) / rate_hz
    speed = 12 * np.sin(2 * np.pi * 0.2 * t) + 5 * np.sin(2 * np.pi * 0.83 * t)
    torque = 0.012 * np.tanh(speed / 0.3) + 0.002 * rng.standard_normal(t.size)
    current = 0.05 * np.gradient(speed, t) + 0.1 * speed + torque / 0.3
    simulated = current - torque / 0.3
    measured = current + 0.02 * rng.standard_normal(t.size)
    measured[int(SPIKE_S * rate_hz) : int(SPIKE_S * rate_hz) + 1] = 9.0
    measured[(t > 20) & (t < 20.4)] = np.nan
    return {"t": t, "speed": speed, "torque": torque, "measured": measured, "simulated": simulated}


def _time_figures(s: dict[str, F64]) -> tuple[TimeSeries, ...]:
    t, torque = s["t"], s["torque"]
    volts = np.round(24 * np.sin(2 * np.pi * 0.2 * t) * 8) / 8
    smooth = np.convolve(np.nan_to_num(torque), np.ones(51) / 51, "same")
    held_out = (Span(48, 60, "held out"),)
    return (
        TimeSeries(
            "Current, measured and simulated",
            t,
            (Line("measured", s["measured"]), Line("simulated", s["simulated"], style="dashed")),
            Axis("current", "A"),
            "The simulation lacks what the motor does at every reversal. A cable was loose between 20.0 and 20.4 s.",
            marks=(Mark(20, "cable loose"), Mark(20.4, "cable back"), Mark(SPIKE_S, "spike")),
            spans=held_out,
        ),
        TimeSeries(
            "Speed",
            t,
            (Line("measured", s["speed"] + 0.05 * np.sin(40 * t)), Line("simulated", s["speed"])),
            Axis("speed", "rad/s"),
            spans=held_out,
        ),
        TimeSeries("Applied voltage", t, (Line("voltage", volts, style="steps"),), Axis("voltage", "V")),
        TimeSeries(
            "Missing torque",
            t,
            (
                Line("missing torque", smooth, smooth - 0.001, smooth + 0.001),
                Line("explained", 0.012 * np.sign(smooth)),
            ),
            Axis("torque", "N·m"),
            "The torque that the simulation would have needed, with its 95 % band, and what the cause gives of it.",
            levels=(Mark(0.0, "nothing missing"),),
        ),
    )


def _scatter(s: dict[str, F64]) -> Scatter:
    grid = np.linspace(-17, 17, 401)
    return Scatter(
        "Missing torque against speed",
        (Points("missing torque", s["speed"], s["torque"]),),
        Axis("speed", "rad/s"),
        Axis("torque", "N·m"),
        (Points("Coulomb friction", grid, 0.012 * np.tanh(grid / 0.3)),),
        "The sign of the speed decides, its size does not: dry friction.",
        marks=(Mark(0, "standstill"),),
    )


def _spectrum() -> Spectrum:
    f = np.geomspace(0.05, 500, 4000)
    rng = np.random.default_rng(3)
    before = 1e-3 / (1 + (f / 5) ** 2) * np.exp(0.3 * rng.standard_normal(f.size)) + 1e-8
    after = 1e-6 * np.exp(0.3 * rng.standard_normal(f.size))
    after[10] = 0.0
    lines = (Line("before", before), Line("after", after))
    return Spectrum(
        "Spectrum of the residual", f, lines, Axis("density", "A²/Hz", log=True), marks=(Mark(0.2, "reversal"),)
    )


def _tables() -> tuple[Table, Table]:
    columns = (Column("parameter", text=True), Column("value"), Column("nominal", digits=4), Column("unit", text=True))
    parameters = Table(
        "Parameters after the fit",
        columns,
        (
            ("R resistance", Measured(0.4937, 0.0012), 0.7011, "Ω"),
            ("J inertia", Measured(9.751e-3, 1.2e-5), 9.027e-3, "kg·m²"),
            ("L inductance", Measured(2.27e-3, float("inf")), 2.348e-3, "H"),
            ("τ_c Coulomb torque", Measured(0.01203, 0.00009), None, "N·m"),
        ),
        "± is one standard deviation; ± ∞: these data do not determine it.",
        chosen=(3,),
    )
    names = ("R", "L", "K", "J", "B", "τ_c", "τ_s", "v_s", "T_load")
    rows = tuple((a, *(float(np.cos(i - k)) for k in range(len(names)))) for i, a in enumerate(names))
    wide = (Column("", text=True), *(Column(name, decimals=3) for name in names))
    return parameters, Table("Correlations of the estimates", wide, rows)


def demo_report(seconds: float = 60.0, rate_hz: float = 1000.0) -> Report:
    """Everything a report can hold."""
    s = signals(seconds, rate_hz)
    k = np.arange(9.0)
    cost = Iterations(
        "Cost of each iteration",
        k,
        (Line("from the paper's start", 308.1 * 10.0 ** (-k / 1.4) + 0.7), Line("from nominal", 40 * 2.0**-k + 0.7)),
        Axis("cost", "", log=True),
    )
    bars = Bars(
        "Error removed on held-out data",
        (
            Bar("Coulomb friction", 0.912, 0.884, 0.937, "1 parameter", chosen=True),
            Bar("Stribeck friction", 0.913, 0.881, 0.941, "3 parameters, earns none"),
            Bar("gravity", 0.03, -0.021, 0.08),
            Bar("winding heating", -0.012, -0.05, float("inf")),
        ),
        Axis("part of the error"),
        "With the 95 % interval of a block bootstrap.",
    )
    verdict = Verdict("warn", "The simulation lacks Coulomb friction", ("It removes 91 % (88 … 94 %) of the error.",))
    good = Verdict("good", "Nothing else is missing", ())
    toml = Code('[[drive.effects]]\nname = "coulomb_friction"\ntau_c = 0.01203', "Into the daemon's configuration")
    equations = (
        Equation(r"J\,\dot{\omega} = K\,i - B\,\omega - \tau_c\,\operatorname{sgn}(\omega) - T_\mathrm{load}", "ω ≠ 0"),
        Equation(r"L\,\frac{di}{dt} = V - R\,i - K\,\omega"),
        Equation(r"\notacommand{x} < 3"),
    )
    short = Items(("Stribeck friction: these data cannot tell it apart.", "Reverse slowly to tell."))
    sections = (
        Section("Verdict", (verdict, Text("One paragraph.\n\nAnd another, about " + HOSTILE), short, toml)),
        Section("Measured and simulated", _time_figures(s)),
        Section("The named cause", (*equations, _scatter(s), bars, _tables()[0])),
        Section("What is left", (good, _spectrum(), cost, _tables()[1])),
    )
    captures = (CaptureFile("axis1.csv.gz", "ab" * 32), CaptureFile(HOSTILE, "cd" * 32))
    made = datetime(2026, 3, 1, 12, 0, 0, tzinfo=UTC)
    provenance = Provenance("servo-daemon diagnose axis1.csv.gz --out report/", "0.1.0", made, captures)
    return Report("Diagnosis of axis1", "60 s at 1 kHz, position and current", sections, provenance)


if __name__ == "__main__":
    write_report(Path(sys.argv[1]), demo_report())
