"""What the documents of many drives say together, from made-up documents."""

from __future__ import annotations

from typing import Any

import numpy as np

from servo_daemon.commands.fleet.analysis import analyse
from servo_daemon.commands.fleet.document import fleet_document
from servo_daemon.commands.fleet.report import fleet_report
from servo_daemon.commands.fleet.tables import drive_rows, parameter_rows
from servo_daemon.report import Table, make_provenance

RNG = np.random.default_rng(8)


def fit(R: float, *, K: float | None = 0.05) -> dict[str, Any]:
    def row(value: float | None, unit: str) -> dict[str, Any]:
        known = value is not None
        std = 0.01 * value if known else None
        return {"value": value, "std": std, "unit": unit, "status": "estimated" if known else "undetermined"}

    return {
        "parameters": {"R": row(R, "Ω"), "K": row(K, "N·m/A")},
        "residual": {"white": True},
        "correlation": {"R": {"R": 1.0, "K": 0.5}, "K": {"K": 1.0, "R": 0.5}},
    }


def drive(number: int, R: float, *, each: tuple[float, ...] = (), K: float | None = 0.05) -> dict[str, Any]:
    return {
        "drive": f"axis{number}",
        "captures": ["a.csv"],
        "seconds": 0.1,
        "fit": fit(R, K=K),
        "each": [fit(r) for r in each],
    }


def make_fleet(n: int = 20) -> list[dict[str, Any]]:
    return [drive(k, 2.0 * float(np.exp(0.05 * RNG.normal())), each=(2.0, 2.01, 1.99, 2.0)) for k in range(n)]


def test_a_stranger_what_drifts_and_what_failed_are_told() -> None:
    documents = [*make_fleet(), drive(20, 3.2), drive(21, 2.0, each=(1.8, 1.95, 2.1, 2.25))]
    documents.append({"drive": "axis22", "captures": ["b.csv"], "seconds": 0.0, "error": "b.csv: too short"})
    told = fleet_document(analyse(documents), "fit")
    assert [row["drive"] for row in told["strangers"]] == ["axis20"]
    assert told["strangers"][0]["off"][0]["parameter"] == "R"
    assert [(row["drive"], row["parameter"]) for row in told["drifting"]] == [("axis21", "R")]
    assert abs(told["drifting"][0]["change"] - 0.25) < 0.03
    assert told["failed"] == [{"drive": "axis22", "error": "b.csv: too short"}]
    assert [row["parameter"] for row in told["common"]] == ["R", "K"]


def test_a_value_that_a_drive_does_not_determine_is_pooled_and_its_own_stays_absent() -> None:
    documents = [*make_fleet(), drive(20, 2.0, K=None)]
    fleet = analyse(documents)
    rows = {(r["drive"], r["parameter"]): r for r in parameter_rows(fleet)}
    row = rows["axis20", "K"]
    assert row["value"] is None and row["std"] is None
    assert abs(row["pooled_value"] / 0.05 - 1.0) < 0.02 and row["pooled_std"] > 0.0


def test_few_drives_have_their_own_values_only() -> None:
    fleet = analyse(make_fleet(4))
    assert fleet.pooled is None
    assert all(row["pooled_value"] is None for row in parameter_rows(fleet))
    assert [row["stranger"] for row in drive_rows(fleet)] == [None] * 4
    assert fleet_document(analyse([]), "fit")["drives"] == 0


def test_two_types_are_told_and_not_pooled() -> None:
    others = [drive(k, 0.9 + 0.01 * k, K=0.1) for k in range(20, 26)]
    fleet = analyse([*make_fleet(), *others])
    told = fleet_document(fleet, "fit")
    assert fleet.pooled is None and told["common"] == []
    assert [len(row["drives"]) for row in told["types"]] == [20, 6]
    assert told["types"][1]["text"].startswith("6 drives: R 1.12 Ω, K 0.1 N·m/A; axis20, axis21")
    assert "2 types" in fleet_report(fleet, make_provenance([])).sections[0].blocks[0].headline
    assert not analyse([*make_fleet(), *others[:2]]).types  # strangers


def test_what_a_result_does_not_say_is_told() -> None:
    documents = make_fleet(3)
    documents[0]["fit"]["residual"]["white"] = False
    for row in documents[1]["fit"]["parameters"].values():
        row |= {"value": None, "std": None, "status": "undetermined"}
    documents[2]["unread"] = ["c.csv: the file is empty"]
    fleet = analyse(documents)
    told = fleet_document(fleet, "fit")
    assert told["untold"][0].startswith("axis0: the model leaves more than noise")
    assert told["untold"][1] == "axis1: its captures determine none of R, K"
    assert told["unread"] == ["axis2: c.csv: the file is empty"]
    verdict = fleet_report(fleet, make_provenance([])).sections[0].blocks[0]
    assert "1 capture cannot be read" in verdict.lines


def test_a_plot_of_few_drives_names_each_by_its_number() -> None:
    fleet = analyse([drive(k, 2.0 - 0.01 * k) for k in range(9)])
    plot = fleet_report(fleet, make_provenance([])).sections[1].blocks[0]
    assert "1 axis8, 2 axis7" in plot.caption and plot.caption.endswith("9 axis0.")


def test_a_capture_that_is_there_twice_counts_once() -> None:
    documents = [row | {"digests": [row["drive"]]} for row in make_fleet(9)]
    again = drive(9, 2.0) | {"digests": ["axis3"]}
    fleet = analyse([*documents, again])
    assert len(fleet.documents) == 9
    assert [d["error"] for d in fleet.failed] == ["the same capture as that of axis3: left out"]


def test_an_effect_of_few_drives_is_told_beside_a_stranger() -> None:
    documents = make_fleet()
    for document in documents:
        document["diagnosis"] = {"verdict": "none", "effects": []}
    odd = drive(20, 3.2) | {"diagnosis": {"verdict": "found", "effects": [{"name": "coulomb_friction"}]}}
    told = fleet_document(analyse([*documents, odd]), "diagnose")
    assert told["causes"] == {"coulomb_friction": 1}
    assert told["strangers"][0]["effects"] == ["coulomb_friction"]
    assert "coulomb_friction" in told["strangers"][0]["text"]


def test_the_page_of_few_drives_shows_each_and_names_those_with_an_effect() -> None:
    documents = make_fleet(3)
    documents[1]["diagnosis"] = {"verdict": "found", "effects": [{"name": "coulomb_friction"}]}
    result = fleet_report(analyse(documents), make_provenance(["fleet"])).sections[0]
    tables = {b.caption: b for b in result.blocks if isinstance(b, Table)}
    assert [row[0] for row in tables["Each drive's own values"].rows] == ["axis0", "axis1", "axis2"]
    assert [row[2] for row in tables["Effects that were named"].rows] == ["1 of 3: axis1"]
