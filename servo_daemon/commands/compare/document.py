"""The JSON document of `compare`, from which its text and its report are made as well."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from servo_daemon.commands.fit.document import iteration_rows, null_row, parameter_row, residual_row, score_row
from servo_daemon.identification.output_error import OutputErrorFit
from servo_daemon.identification.paper.compare import HELD_OUT, Comparison, MethodResult
from servo_daemon.identification.paper.paper import RESULT, START, TABLE_1, PaperRedone, noise_floor
from servo_daemon.identification.paper.position_experiment import REPORTED_DEG, STEP_DEG, TEST_S, PositionTest


def capture_document(c: Comparison) -> dict[str, Any]:
    """The methods on one capture."""
    return {
        "capture": str(c.capture.path),
        "held_out_share": HELD_OUT,
        "assumed_R": c.assumed_R,
        "truth": dict(c.truth) or None,
        "position_test": {
            "step_deg": STEP_DEG,
            "time_s": TEST_S,
            "k_io_k_s_V_rad": c.product_V_rad,
            "gain_chosen_by": c.product_source,
            "reference": c.reference,
            "reference_final_deg": None if c.reference_test is None else c.reference_test.final_deg,
        },
        "methods": {m.key: method_row(m) for m in c.methods},
    }


def method_row(m: MethodResult) -> dict[str, Any]:
    """One method; `available` says whether it has a result."""
    return {
        "title": m.title,
        "available": bool(m.parameters),
        "reason": m.reason or None,
        "parameters": {
            name: {"value": e.value, "std": e.std if math.isfinite(e.std) else None, "unit": e.unit}
            for name, e in m.parameters.items()
        },
        "errors": dict(m.errors or {}),
        "heldout": None if m.heldout is None else score_row(m.heldout, linear=False),
        "position_test": None if m.position is None else position_row(m.position),
        "notes": list(m.notes),
        "seconds": m.seconds,
    }


def position_row(t: PositionTest) -> dict[str, Any]:
    """The 50° test in numbers."""
    return {
        "final_deg": t.final_deg,
        "overshoot": t.overshoot,
        "distance_deg": t.distance_deg,
        "stable": t.stable,
    }


def paper_document(p: PaperRedone) -> dict[str, Any]:
    """The paper's numbers and ours."""
    return {
        "method1_paper": dict(p.method1.values),
        "method1_printed": {c.name: c.printed for c in p.method1.comparison},
        "method1_digits": {
            c.name: {
                "printed": c.printed,
                "ours": c.rounded,
                "value": c.value,
                "unit": c.unit,
                "digits": c.digits,
                "agreeing": c.agreeing,
                "input": c.is_input,
            }
            for c in p.method1.comparison
        },
        "method1_other_root": {"J": p.method1.other_root.J, "L": p.method1.other_root.L},
        "method1_note": p.method1.note,
        "method2_paper": dict(RESULT),
        "paper_position_test": {
            "step_deg": STEP_DEG,
            "time_s": TEST_S,
            "k_io_k_s_V_rad": p.product_V_rad,
            "chosen": f"k_io·k_s, so that method 1 stands at the reported {REPORTED_DEG:g}°",
            "reproduced": "method 2's final angle (reported as 99 %)",
            "methods": {name: position_row(t) for name, t in p.tests.items()},
        },
        "table1": {
            "paper": [{"iteration": i, "function_count": f, "cost": c} for i, f, c in TABLE_1],
            "start": dict(START),
            "angle_alone": _run_row(p.from_angle),
            "current_and_angle": _run_row(p.from_both),
        },
    }


def _run_row(fit: OutputErrorFit) -> dict[str, Any]:
    rows = iteration_rows(fit)
    return {
        "iterations": rows,
        "fall": rows[0]["cost"] / rows[-1]["cost"],
        "parameters": {name: parameter_row(p, linear=False) for name, p in fit.parameters.items()},
        "errors_in_std": _errors_in_std(fit),
        "null_directions": [null_row(d) for d in fit.null_directions],
        "residual": residual_row(fit, linear=False),
        "noise_floor": noise_floor(fit),
        "start": fit.start,
    }


def _errors_in_std(fit: OutputErrorFit) -> Mapping[str, float]:
    return {
        name: (p.value - RESULT[name]) / p.std
        for name, p in fit.parameters.items()
        if p.value is not None and p.std is not None
    }
