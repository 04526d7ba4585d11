"""What `diagnose` prints for a reader."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Any

from servo_daemon.commands.diagnose.criterion import by_balance, error_heading
from servo_daemon.commands.diagnose.hints import experiment
from servo_daemon.commands.diagnose.words import change_text, headline, model_name, percent, verdict_lines
from servo_daemon.commands.fit.text import open_lines, parameter_line, validation_lines
from servo_daemon.parameters import spaced

#: Columns of the text.
_WIDTH = 100


def print_diagnosis(document: Mapping[str, Any]) -> None:
    """The document of `diagnose` as text on stdout."""
    print("\n".join(diagnosis_lines(document)))


def diagnosis_lines(document: Mapping[str, Any]) -> list[str]:
    """Verdict, named effects, what is left, candidates, other captures, lines of TOML."""
    lines = [*_wrapped(headline(document)), *(x for text in verdict_lines(document) for x in _wrapped(text, "  "))]
    for effect in document["effects"]:
        lines += ["", *_effect_lines(effect)]
    lines += _open_lines(document)
    lines += ["", *_error_lines(document), *_candidate_lines(document), *_difference_lines(document)]
    lines += validation_lines(document)
    if document["toml"]:
        lines += ["", "For the drive's configuration, below [[drive]]:"]
        lines += [f"  {line}" for line in document["toml"].splitlines()]
    return [*lines, "", f"{', '.join(document['captures'])}: {document['seconds']:.1f} s"]


def _wrapped(text: str, indent: str = "") -> list[str]:
    return fill(text, _WIDTH, initial_indent=indent, subsequent_indent=indent).splitlines()


def _effect_lines(effect: Mapping[str, Any]) -> list[str]:
    gain = "" if effect["gain"] is None else f"   (without it {percent(effect['gain'])} of that error comes back)"
    lines = [effect["name"] + gain, *_wrapped(effect["cause"], "  ")]
    for name, p in effect["parameters"].items():
        line = parameter_line(name, p)
        lines.append(f"{line} {p['choice']}" if "choice" in p else line)
    for names in effect["equivalent"]:
        lines += _wrapped(
            f"These data cannot tell it from {' + '.join(names)}: {experiment(effect['name'], names)}", "  "
        )
    return lines


def _open_lines(document: Mapping[str, Any]) -> list[str]:
    """What the data leave open; what they determine instead only where they leave much open."""
    parameters = (document["extended"] or document["baseline"])["parameters"].values()
    few = 2 * sum(p["status"] == "undetermined" for p in parameters) < len(parameters)
    return open_lines({**document, "combinations": []} if few and not by_balance(document) else document)


def _error_lines(document: Mapping[str, Any]) -> list[str]:
    """Held-out errors of both models."""
    models = [m for m in (document["baseline"], document["extended"]) if m is not None]
    lines = [f"{error_heading(document)}, rms:"]
    for m in models:
        sizes = ", ".join(f"{name} {_number(value)}" for name, value in m["heldout_rmse"].items())
        lines.append(f"  {model_name(m['model'])}: {sizes or 'nothing was held out'}{_share(m['heldout_nrmse'])}")
    if document["noise_floor"] is not None:
        lines.append(f"  noise alone would leave {percent(document['noise_floor'])} of the signals")
    return lines


def _share(nrmse: float | None) -> str:
    return "" if nrmse is None else f" ({percent(nrmse)} of the signals)"


def _number(value: float | None) -> str:
    return "—" if value is None else f"{value:.4g}"


def _candidate_lines(document: Mapping[str, Any]) -> list[str]:
    """The last round's losers are what the reader asks for first."""
    if not document["candidates"]:
        return []
    lines = ["", "Tried (error on the part that decides, ΔBIC):"]
    beside = None
    for c in document["candidates"]:
        if c["beside"] != beside:
            beside = c["beside"]
            lines.append(f"  beside {model_name(beside)}:")
        error = "—" if c["heldout_nrmse"] is None else percent(c["heldout_nrmse"])
        bic = "—" if c["delta_bic"] is None else f"{c['delta_bic']:+.0f}"
        lines.append(f"    {c['name']:<28} {error:>8}  {bic:>9}{'  ◀ taken' if c['taken'] else ''}")
    return lines


def _difference_lines(document: Mapping[str, Any]) -> list[str]:
    if not document["differences"]:
        return []
    lines = ["", "What differs between the captures:"]
    for d in document["differences"]:
        each = ", ".join(
            f"{_number(value)}{'' if std is None else f' ± {std:.2g}'}"
            for value, std in zip(d["values"], d["stds"], strict=True)
        )
        change = change_text(d["values"])
        lines.append(f"  {d['name']} = {each}{spaced(d['unit'])}{f'   ({change})' if change else ''}")
    if document["own_models"]:
        lines.append("What that means for one free run over all of each, rms:")
    for m in document["own_models"]:
        each = ", ".join(
            f"{name} {_number(v)} → {_number(m['own_rmse'][name])}" for name, v in m["shared_rmse"].items()
        )
        lines.append(f"  {Path(m['capture']).name}: {each} with its own values")
    return lines
