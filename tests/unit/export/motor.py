"""One identified motor, as `fit` writes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

#: An RE 40 with a gear of 5 and what hides in it: value, 1 σ, unit.
VALUES: dict[str, tuple[float, float | None, str]] = {
    "R": (1.1, 0.01, "Ω"), "L": (1e-3, 1e-5, "H"), "K": (0.06, 1e-3, "N·m/A"), "J": (5e-5, 1e-6, "kg·m²"),
    "B": (3e-5, 1e-6, "N·m·s/rad"), "Tc": (0.01, 1e-4, "N·m"), "Ts": (0.014, 1e-4, "N·m"), "ws": (2.0, 0.1, "rad/s"),
    "Tcog": (0.004, 1e-4, "N·m"), "n_cog": (12.0, None, "1"), "phi_cog": (0.4, 0.01, "rad"),
    "R_th": (5.0, 0.1, "K/W"), "C_th": (10.0, 0.1, "J/K"), "c2": (1e-5, 1e-7, "N·m·s²/rad²"), "Vb": (0.1, 0.01, "V"),
    "k_s": (2.0, 0.1, "N·m/rad"), "c_s": (1e-3, 1e-5, "N·m·s/rad"), "J_l": (3e-5, 1e-6, "kg·m²"),
    "Tg": (0.02, 1e-4, "N·m"), "phi_g": (0.5, 0.01, "rad"),
}  # fmt: skip
#: `export` and what it says, as one call: (exit code, stderr).
Exporting = Callable[..., tuple[int, str]]


def document(*effects: str, names: tuple[str, ...] = (), gear: float = 5.0, **changed: Any) -> dict[str, Any]:
    """A fit.json of R, L, K, J, B and these further parameters; `changed`: rows that are otherwise."""
    rows = {
        name: {"value": v, "std": std, "unit": unit, "at_bound": False, "status": "estimated" if std else "fixed"}
        for name, (v, std, unit) in VALUES.items()
        if name in ("R", "L", "K", "J", "B", *names)
    }
    for name, row in changed.items():
        rows[name] = {**rows[name], **row}
    signals = {"convention": "dc", "publish": "phase", "pole_pairs": 1, "gear_ratio": gear}
    return {
        "model": list(effects),
        "input": "voltage",
        "measured": ["current_A"],
        "parameters": rows,
        "signals": signals,
    }
