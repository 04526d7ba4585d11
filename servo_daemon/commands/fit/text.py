"""What `fit` prints for a reader."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from servo_daemon.parameters import spaced


def print_fit(document: Mapping[str, Any]) -> None:
    """The document of `fit` as text on stdout."""
    print("\n".join(fit_lines(document)))


def fit_lines(document: Mapping[str, Any]) -> list[str]:
    """Lines: parameters, what is open, the residual, the validation."""
    model = " + ".join(["linear motor", *document["model"]])
    lines = [f"{', '.join(document['captures'])}: {model}, {document['method']}", ""]
    lines += [
        f"No values: the model explains next to nothing of {name} "
        "(a load or friction that the model lacks, a turned sign, or a wrong unit)."
        for name in document.get("unexplained", ())
    ]
    lines += [parameter_line(name, p) for name, p in document["parameters"].items()]
    lines += open_lines(document)
    lines += ["", *_residual_lines(document), *validation_lines(document)]
    for name, share in document["residual"].get("relative_error", {}).items():
        lines.append(f"relative error of {name}: {100 * share:.3f} %")
    last = document["iterations"][-1] if document["iterations"] else None
    if last is not None:
        lines.append(
            f"{last['iteration']} iterations, {last['function_count']} simulations, {document['seconds']:.2f} s, "
            f"from {document['start']}" + ("" if document["converged"] else "; NOT CONVERGED")
        )
    return lines


def parameter_line(name: str, p: Mapping[str, Any]) -> str:
    """'R = 0.4937 ± 0.0002 Ω'."""
    remark = {"fixed": "  (held)", "searched": "  (by search)", "undetermined": "  (not determined by these data)"}.get(
        p["status"], ""
    )
    if p["at_bound"]:
        remark = f"  (not determined: at bound {p['bound']:.6g}{spaced(p['unit'])})"
    value = "—" if p["value"] is None else f"{p['value']:.6g}"
    std = "" if p["std"] is None else f" ± {p['std']:.2g}"
    if p.get("std_white") is not None:
        std += f" (± {p['std_white']:.2g} if the residual were white)"
    return f"  {name:>8} = {value}{std}{spaced(p['unit'])}{remark}"


def open_lines(document: Mapping[str, Any]) -> list[str]:
    """What the data leave open, and what they determine instead."""
    lines = []
    if document["null_directions"]:
        lines += ["", "These data do not determine everything:"]
        lines += [f"  {d['text']}" for d in document["null_directions"]]
    if document["combinations"]:
        lines.append("They do determine:")
        lines += [
            f"  {c['expression']} = {c['value']:.5g} ± {c['std']:.2g} {c['unit']}" for c in document["combinations"]
        ]
    return lines


def _residual_lines(document: Mapping[str, Any]) -> list[str]:
    residual = document["residual"]
    what = (
        "white: the model explains these data to their noise"
        if residual["white"]
        else ("not white: the model lacks something, or the noise is coloured; try `--effect`")
    )
    noise = residual.get("noise_model")
    if noise is not None:
        what = f"explained by noise of {noise['voltage_noise_V']:.2g} V on the voltage that the capture does not show"
    sizes = ", ".join(f"{name} {value:.4g}" for name, value in residual["rmse"].items())
    return [f"residual rms: {sizes}; {what}"]


def validation_lines(document: Mapping[str, Any]) -> list[str]:
    """RMS errors on the captures that were only scored."""
    lines = []
    for v in document["validation"]:
        lines.append(f"validation {v['capture']}:")
        for kind in ("baseline", "extended", "adapted"):
            if v[kind] is not None:
                lines += [f"  {kind:>8} {_score(v[kind])}"]
        if v["adapted"] is not None:
            lines += [f"           {settled_words(v['adapted'])}"]
    return lines


def settled_words(adapted: Mapping[str, Any]) -> str:
    """What has settled on the first part of a capture, and at what."""
    values = ", ".join(f"{name} {value:.4g}" for name, value in adapted["settled"].items())
    if values:
        return f"settled on the first part: {values}"
    return (
        "nothing settled: the first part is predicted as well as the fitted data, or does not determine friction and "
        "offsets"
    )


def _score(scores: Mapping[str, Any]) -> str:
    return "; ".join(
        f"{name} {scores['rmse'][name]:.4g} (1 s: {scores['rmse_1s'][name]:.4g}{_band(scores, name)})"
        for name in scores["rmse"]
    )


def _band(scores: Mapping[str, Any], name: str) -> str:
    """', 95 % band ± 0.3, expected 0.01 … 0.4'."""
    band = scores.get("band95", {}).get(name)
    if band is None:
        return ""
    low, high = band["expected_rmse"]
    return f", 95 % band ± {band['half_width']:.2g}, expected {low:.2g} … {high:.2g}"
