"""The page about a fleet: how its parameters are distributed, which drives are not like the others, what drifts."""

from __future__ import annotations

from typing import Any

import numpy as np

from servo_daemon.commands.fleet.analysis import Drift, Fleet
from servo_daemon.commands.fleet.tables import prior_rows
from servo_daemon.plant.effects import effects_by_name, parameter_table
from servo_daemon.report import Axis, Column, Items, Measured, Plot, Provenance, Report, Section, Table, Text, Verdict
from servo_daemon.report.document import Block
from servo_daemon.report.figures import Line, Mark

#: Lines of a list before it says how many more there are; all of them are in the tables.
_MOST_LINES = 50
#: Names of drives in one cell, and below a plot of all.
_MOST_NAMES, _MOST_NUMBERED = 8, 30


def fleet_report(fleet: Fleet, provenance: Provenance) -> Report:
    """The page of the fleet."""
    sections = [Section("Result", (_verdict(fleet), *_summary(fleet)))]
    if fleet.pooled is not None:
        sections.append(Section("Distributions", tuple(_distribution(fleet, j) for j in range(len(fleet.names)))))
    return Report("Fleet", counted_drives(len(fleet.documents)), tuple(sections), provenance)


def _verdict(fleet: Fleet) -> Verdict:
    lines = tuple(
        line
        for line in (
            _counted(len(fleet.failed), "drive gave no result", "drives gave no result"),
            _counted(len(unread(fleet)), "capture cannot be read", "captures cannot be read"),
            _counted(len(strangers(fleet)), "drive is not like the others", "drives are not like the others"),
            _counted(sum(map(bool, fleet.drifts)), "drive drifts", "drives drift"),
        )
        if line
    )
    many = counted_drives(len(fleet.documents))
    if not fleet.documents:
        return Verdict("bad", "No drive gave a result", lines)
    if fleet.types:
        more = "a mean between them is no motor: run fleet on the captures of each type"
        return Verdict("warn", f"{many} of {len(fleet.types)} types", (more, *lines))
    if fleet.pooled is None:
        return Verdict("warn", f"{many}: too few to tell what they have in common", lines)
    return Verdict("warn" if lines else "good", f"{many} of one type", lines)


def counted_drives(n: int) -> str:
    return "1 drive" if n == 1 else f"{n} drives"


def _counted(n: int, one: str, many: str) -> str:
    return "" if n == 0 else f"{n} {one if n == 1 else many}"


def strangers(fleet: Fleet) -> list[int]:
    """Drives that do not belong to the others."""
    return [] if fleet.pooled is None else np.flatnonzero(fleet.pooled.stranger).tolist()


def stranger_text(fleet: Fleet, k: int) -> str:
    """'axis7: R +38 % (7.1 σ); coulomb_friction is named'."""
    off = [
        f"{name} {d:+.1%} ({z:+.1f} σ)" if fleet.logarithmic[fleet.names.index(name)] else f"{name} ({z:+.1f} σ)"
        for name, d, z in fleet.deviations(k)[:3]
    ]
    causes = [f"{name}: {effects_by_name()[name].cause}" for name in fleet.rare_effects(k)]
    return f"{fleet.documents[k]['drive']}: {'; '.join([', '.join(off), *causes])}"


def drift_text(fleet: Fleet, k: int, drift: Drift) -> str:
    """'axis3: R +12.0 % (9 σ) from its first capture to its last'."""
    unit = parameter_table()[drift.parameter].unit
    change = f"{drift.change:+.1%}" if drift.relative else f"{drift.change:+.3g} {unit}"
    return (
        f"{fleet.documents[k]['drive']}: {drift.parameter} {change} ({abs(drift.z):.0f} σ) "
        "from its first capture to its last"
    )


def drifting(fleet: Fleet) -> list[tuple[int, Drift]]:
    """Drives that drift, by number, the surest first."""
    found = [(k, d) for k, drifts in enumerate(fleet.drifts) for d in drifts]
    return sorted(found, key=lambda pair: -abs(pair[1].z))


def _summary(fleet: Fleet) -> list[Block]:
    blocks: list[Block] = []
    if rows := prior_rows(fleet):
        columns = (
            Column("parameter", text=True),
            Column("mean ± std"),
            Column("unit", text=True),
            Column("between drives", text=True),
        )
        table = tuple(
            (r.parameter, Measured(r.value, r.std), r.unit, f"{r.spread:.1%}" if r.logarithmic else f"{r.spread:.3g}")
            for r in rows
        )
        blocks.append(Table("What the drives have in common", columns, table))
    else:
        blocks += _each(fleet)
    if fleet.causes:
        share = tuple((name, effects_by_name()[name].cause, drives_with(fleet, name)) for name in ranked_causes(fleet))
        headings = tuple(Column(name, text=True) for name in ("effect", "cause", "drives"))
        blocks.append(Table("Effects that were named", headings, share))
    lists: list[tuple[str, list[str]]] = [
        ("Types", type_texts(fleet)),
        ("Not like the others", [stranger_text(fleet, k) for k in strangers(fleet)]),
        ("What drifts", [drift_text(fleet, k, d) for k, d in drifting(fleet)]),
        ("Told with care", untold(fleet)),
        ("No result", [f"{d['drive']}: {d['error']}" for d in fleet.failed]),
        ("Left out", [*unread(fleet), *repeated(fleet)]),
    ]
    for title, lines in lists:
        if lines:
            more = [f"and {len(lines) - _MOST_LINES} more"] if len(lines) > _MOST_LINES else []
            blocks += [Text(title), Items(tuple(lines[:_MOST_LINES] + more))]
    return blocks


def type_texts(fleet: Fleet) -> list[str]:
    """'8 drives: R 0.52 Ω, K 0.3 N·m/A; axis1, axis2, …' of each type; none where there is one."""
    return [type_text(fleet, group.tolist()) for group in fleet.types]


def type_text(fleet: Fleet, group: list[int]) -> str:
    medians = np.median(fleet.own[group], axis=0)
    back = [float(np.exp(m)) if log else float(m) for m, log in zip(medians, fleet.logarithmic, strict=True)]
    units = [parameter_table()[name].unit for name in fleet.names]
    values = ", ".join(f"{n} {v:.3g} {u}" for n, v, u in zip(fleet.names, back, units, strict=True))
    return f"{len(group)} drives: {values}; {_named([fleet.documents[k]['drive'] for k in group])}"


def untold(fleet: Fleet) -> list[str]:
    """Drives whose captures say less than a result seems to: no value at all, or more than the model explains."""
    lines = []
    for d in fleet.documents:
        rows = d["fit"]["parameters"]
        if all(row["value"] is None for row in rows.values()):
            lines.append(f"{d['drive']}: its captures determine none of {', '.join(rows)}")
        elif d["fit"].get("residual", {}).get("white") is False:
            lines.append(f"{d['drive']}: the model leaves more than noise; `fleet diagnose` looks for what it lacks")
    return lines


def unread(fleet: Fleet) -> list[str]:
    """What is wrong with captures that a drive with others was told without."""
    return [f"{d['drive']}: {text}" for d in fleet.documents for text in d.get("unread", ())]


def repeated(fleet: Fleet) -> list[str]:
    """Captures that are others of the same drive once more."""
    return [f"{c}: the same as another capture of {d['drive']}" for d in fleet.documents for c in d.get("repeated", ())]


def ranked_causes(fleet: Fleet) -> list[str]:
    """Effects that were named, the commonest first."""
    return sorted(fleet.causes, key=lambda name: -fleet.causes[name])


def drives_with(fleet: Fleet, effect: str) -> str:
    """'2 of 6: axis1, axis4'."""
    names = [d["drive"] for k, d in enumerate(fleet.documents) if effect in fleet.effects_of(k)]
    return f"{len(names)} of {len(fleet.documents)}: {_named(names)}"


def _named(names: list[str]) -> str:
    more = [f"and {len(names) - _MOST_NAMES} more"] if len(names) > _MOST_NAMES else []
    return ", ".join(names[:_MOST_NAMES] + more)


def _each(fleet: Fleet) -> list[Block]:
    """Each drive's own values, where nothing says more than they do."""
    documents = fleet.documents[:_MOST_LINES]
    units = {n: row["unit"] for d in documents for n, row in d["fit"]["parameters"].items()}
    if not units:
        return []
    columns = tuple(Column(name, unit) for name, unit in units.items())
    rows = tuple((d["drive"], *(_own(d["fit"]["parameters"].get(name)) for name in units)) for d in documents)
    return [Table("Each drive's own values", (Column("drive", text=True), *columns), rows)]


def _own(row: Any) -> Measured | str:
    if row is None or row["value"] is None:
        return "–"
    return Measured(row["value"], row["std"])


def _distribution(fleet: Fleet, j: int) -> Plot:
    """Drives in the order of their pooled values, own values beside them."""
    assert fleet.pooled is not None
    name, log = fleet.names[j], fleet.logarithmic[j]
    order = np.argsort(fleet.pooled.mean[:, j])
    back: Any = np.exp if log else (lambda x: x)
    own, pooled = fleet.own[order, j], fleet.pooled.mean[order, j]
    half = 1.96 * np.sqrt(fleet.pooled.cov[order, j, j])
    names = [fleet.documents[k]["drive"] for k in order]
    numbered = ", ".join(f"{k} {drive}" for k, drive in enumerate(names, start=1))
    told = numbered if len(names) <= _MOST_NUMBERED else f"from {names[0]} to {names[-1]}"
    mean = float(back(fleet.pooled.prior.mean[j]))
    return Plot(
        f"{name} over the fleet",
        np.arange(1.0, len(order) + 1.0),
        (
            Line("its own captures", back(own), style="dots"),
            Line("with the other drives", back(pooled), back(pooled - half), back(pooled + half)),
        ),
        Axis(name, parameter_table()[name].unit),
        caption=f"The band is the 95 % interval; drives in the order of their values: {told}.",
        x_axis=Axis("drive"),
        levels=(Mark(mean, "mean"),),
        group="drives",
    )
