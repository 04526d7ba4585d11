"""Texts and tables of the report of `diagnose`, all made from its document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from servo_daemon.commands.diagnose.criterion import by_balance, by_predictions, error_heading, measured_data
from servo_daemon.commands.diagnose.hints import experiment
from servo_daemon.commands.diagnose.words import change_text, headline, model_name, remaining_lines, verdict_lines
from servo_daemon.commands.fit.report import open_blocks, parameter_remark, score_table
from servo_daemon.commands.shared.symbols import symbol_text
from servo_daemon.plant.effects import parameter_table as parameter_definitions
from servo_daemon.report import Axis, Bar, Bars, Code, Column, Equation, Items, Measured, Section, Table, Text, Verdict
from servo_daemon.report.document import Block, Cell, Tone

_TONES: Mapping[str, Tone] = {"found": "neutral", "unexplained": "warn", "none": "good"}
#: What the two models are called.
_KINDS = ("baseline", "extended")


def verdict_block(document: Mapping[str, Any]) -> Verdict:
    """The answer in a box."""
    return Verdict(_TONES[document["verdict"]], headline(document), tuple(verdict_lines(document)))


def error_blocks(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """Held-out errors of both models and the gain with its interval."""
    models = _models(document)
    names = list(models[0]["heldout_rmse"])
    if not names:
        return (Text("These data leave no part to hold out."),)
    columns = (
        Column("model", text=True),
        *(Column(n) for n in names),
        Column("all channels", "% of the signals", digits=3),
    )
    rows: list[tuple[Cell, ...]] = [
        (kind, *(m["heldout_rmse"].get(n) for n in names), _hundredfold(m["heldout_nrmse"]))
        for kind, m in zip(_KINDS, models, strict=False)
    ]
    if document["noise_floor"] is not None:
        rows.append(("noise alone", *(None for _ in names), _hundredfold(document["noise_floor"])))
    called = "; ".join(
        f"{kind.capitalize()}: {model_name(m['model'])}" for kind, m in zip(_KINDS, models, strict=False)
    )
    best = ", each from its best initial state" if document["judged_by"] == "free_runs" else ""
    note = f"{error_heading(document)}{best}. {called}."
    table = Table(f"RMS error on {measured_data(document)}", columns, tuple(rows), note=note)
    return (table, *_gain_bars(document))


def _models(document: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [m for m in (document["baseline"], document["extended"]) if m is not None]


def _hundredfold(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


def _gain_bars(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """The share of the removable error that goes, and each effect's part."""
    gain = document["gain"]
    if gain is None or gain["error_removed"] is None:
        return ()
    low, high = gain["ci95"] or (None, None)
    bars = [Bar("all that was found", 100 * gain["error_removed"], _hundredfold(low), _hundredfold(high), chosen=True)]
    caption = "The interval is of 95 %, by a bootstrap over free runs."
    if len(document["effects"]) > 1:
        bars += [
            Bar(f"lost without {e['name']}", 100 * e["gain"]) for e in document["effects"] if e["gain"] is not None
        ]
        caption += " Effects can stand in for each other in part, so that the parts need not add up to the whole."
    axis = Axis("of what is not noise", "%")
    title = f"Error removed on {measured_data(document)}"
    return (Bars(title, tuple(bars), axis, caption, heading="effects"),)


def effect_blocks(effect: Mapping[str, Any]) -> tuple[Block, ...]:
    """Cause, equation, parameters, gain, and what these data cannot tell from it."""
    blocks: list[Block] = [
        Text(effect["cause"]),
        Equation(effect["equation"], "What it adds to the linear motor."),
        _effect_parameters(effect["parameters"]),
    ]
    blocks += [
        Verdict(
            "warn",
            f"These data cannot tell it from {' + '.join(names)}",
            (f"To tell: {experiment(effect['name'], names)}",),
        )
        for names in effect["equivalent"]
    ]
    return tuple(blocks)


def _effect_parameters(parameters: Mapping[str, Mapping[str, Any]]) -> Table:
    """With the symbols of the equation and what they are."""
    columns = (
        Column("parameter", text=True),
        Column("symbol", text=True),
        Column("value ± std"),
        Column("unit", text=True),
        Column("", text=True),
    )
    table = parameter_definitions()
    rows = tuple(
        (name, symbol_text(table[name].symbol), _cell(p), p["unit"], parameter_remark(p))
        for name, p in parameters.items()
    )
    meanings = "; ".join(f"{name}: {table[name].description}" for name in parameters)
    return Table("Parameters", columns, rows, note=f"{meanings}.")


def toml_blocks(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """The lines of TOML to copy into the configuration."""
    return (Code(document["toml"], "In the configuration, below the drive's [[drive]]:"),)


def remaining_blocks(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """What is left and what it follows."""
    rows = tuple(
        (
            name,
            m["before_rms"],
            m["working_rms"],
            m["after_rms"],
            m["after_working_rms"],
            m["std"],
            m["unit"],
        )
        for name, m in document["missing"].items()
    )
    columns = (
        Column("missing", text=True),
        Column("baseline", digits=3),
        Column("its motor works with", digits=3),
        Column("extended", digits=3),
        Column("its motor works with", digits=3),
        Column("std of the estimate", digits=2),
        Column("unit", text=True),
    )
    table = Table("RMS of what is missing", columns, rows)
    return (Items(tuple(remaining_lines(document))), table)


def candidate_blocks(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """One ranked table for each round of the search."""
    rounds: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for c in document["candidates"]:
        rounds.setdefault(tuple(c["beside"]), []).append(c)
    if not rounds:
        return (Text("No effect of the library explains enough of what is missing to be worth a fit."),)
    judge = "times" if by_balance(document) else "free runs"
    text = Text(
        f"Each was fitted together with the motor. The error is that of {judge} that were not fitted and that decide. "
        "An effect is taken if it lowers this error by a margin that resampling does not undo, and if its parameters "
        "are worth their place (ΔBIC well below zero); a simpler effect goes before one that contains it."
    )
    if by_predictions(document):
        text = Text(f"{text.text} Here free runs took none: taken is what the data are far likelier with, and white.")
    return (text, *(_candidate_table(beside, rows) for beside, rows in rounds.items()))


def _candidate_table(beside: Sequence[str], candidates: Sequence[Mapping[str, Any]]) -> Table:
    columns = (
        Column("candidate", text=True),
        Column("error", "% of the signals", digits=3),
        Column("ΔBIC", decimals=0),
    )
    rows = tuple((c["name"], _hundredfold(c["heldout_nrmse"]), c["delta_bic"]) for c in candidates)
    taken = tuple(k for k, c in enumerate(candidates) if c["taken"])
    return Table(f"Beside the {model_name(beside)}", columns, rows, chosen=taken)


def parameter_blocks(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """Every parameter of both models, beside each other."""
    models = _models(document)
    names = list(dict.fromkeys(n for m in models for n in m["parameters"]))
    titles = _KINDS[: len(models)]
    columns = (
        Column("parameter", text=True),
        *(Column(f"{t} ± std") for t in titles),
        Column("unit", text=True),
        Column("", text=True),
    )
    rows = []
    for name in names:
        each = [m["parameters"].get(name) for m in models]
        last = next(p for p in reversed(each) if p is not None)
        rows.append((name, *(_cell(p) for p in each), last["unit"], parameter_remark(last)))
    return (Table("Parameters", columns, tuple(rows)), *open_blocks(document))


def _cell(p: Mapping[str, Any] | None) -> Cell:
    if p is None:
        return None
    if p["status"] == "searched" and p["value"] is not None and float(p["value"]).is_integer():
        return int(p["value"])
    return Measured(p["value"], float("inf") if p["status"] == "undetermined" else p["std"])


def free_run_tables(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """Errors over the diagnosed captures themselves."""
    text = Text(
        "“Baseline” is the linear motor with the effects that its configuration has, fitted to these captures; "
        "“extended” the model with what was found. Free run: one run over all of the capture, from the state of its "
        "first samples; 1 s: runs restarted every second from what was measured. To see how the models do on data that "
        "they were not fitted to, give other captures to --validate."
    )
    return (text, *(score_table(f"RMS error over {Path(v['capture']).name}", v) for v in document["free_runs"]))


def difference_sections(document: Mapping[str, Any]) -> tuple[Section, ...]:
    """Parameters that differ between the captures."""
    if not document["differences"]:
        return ()
    columns = (
        Column("parameter", text=True),
        *(Column(Path(path).name) for path in document["captures"]),
        Column("unit", text=True),
        Column("", text=True),
    )
    rows = tuple(
        (
            x["name"],
            *(Measured(v, s) for v, s in zip(x["values"], x["stds"], strict=True)),
            x["unit"],
            change_text(x["values"]),
        )
        for x in document["differences"]
    )
    text = Text(
        "The same model with the same structure; these parameters differ by more than their standard deviations."
    )
    table = Table("Value ± std", columns, rows)
    return (Section("What differs between the captures", (text, table, *_own_tables(document))),)


def _own_tables(document: Mapping[str, Any]) -> tuple[Block, ...]:
    """How far a free run drifts that does not know the capture's own values."""
    models = document["own_models"]
    if not models:
        return ()
    names = list(models[0]["shared_rmse"])
    columns = (
        Column("capture", text=True),
        *(Column(f"{n}, shared values") for n in names),
        *(Column(f"{n}, its own") for n in names),
    )
    rows = tuple(
        (Path(m["capture"]).name, *(m[kind].get(n) for kind in ("shared_rmse", "own_rmse") for n in names))
        for m in models
    )
    return (Table("RMS error of one free run over all of each capture", columns, rows),)


def note_sections(document: Mapping[str, Any]) -> tuple[Section, ...]:
    """The section of remarks; none where there are none."""
    return (Section("Notes", (Items(tuple(document["notes"])),)),) if document["notes"] else ()
