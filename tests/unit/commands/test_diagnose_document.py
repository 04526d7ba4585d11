"""diagnosis.json, its text and its lines of TOML, for every kind of verdict."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servo_daemon.captures import read_capture
from servo_daemon.commands.diagnose.document import diagnosis_document
from servo_daemon.commands.diagnose.evidence import Evidence, gather_evidence
from servo_daemon.commands.diagnose.hints import experiment
from servo_daemon.commands.diagnose.missing import missing_figures
from servo_daemon.commands.diagnose.report import diagnosis_report
from servo_daemon.commands.diagnose.tables import difference_sections
from servo_daemon.commands.diagnose.text import diagnosis_lines
from servo_daemon.commands.diagnose.words import percent
from servo_daemon.commands.fit.inputs import Inputs
from servo_daemon.commands.shared.symbols import symbol_text
from servo_daemon.config import DriveConfig, load_config, parse_config
from servo_daemon.diagnosis.diagnose import diagnose
from servo_daemon.diagnosis.screening.dependence import Dependence
from servo_daemon.diagnosis.verdict.result import Diagnosis, NamedEffect, OwnModel, Spread
from servo_daemon.plant.effects import effects_by_name, parameter_table
from servo_daemon.report import Report, Spectrum, TimeSeries, make_provenance, render_report
from tests.command_line import run_command

KEYS = {
    *("schema", "verdict", "effects", "baseline", "extended", "noise_floor", "gain", "validation"),
    *("candidates", "remaining"),
}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Diagnosis, Evidence]:
    """Of a motor whose angle is felt 7 times a turn."""
    path = tmp_path_factory.mktemp("document") / "cogging.csv"
    effect = "cogging_torque:Tcog=0.2,n_cog=7,phi_cog=1"
    assert run_command("simulate", "--out", path, "--seconds", "5", "--seed", "2", "--effect", effect).code == 0
    diagnosis = diagnose([read_capture(path)])
    return diagnosis, gather_evidence(diagnosis)


def inputs_of(d: Diagnosis, **more: Any) -> Inputs:
    given: dict[str, Any] = {"nominal": {}, "fixed": {}, "notes": ()} | more
    return Inputs(drive=DriveConfig(), captures=d.captures, validation=(), effects=(), baseline=(), **given)


def document_of(d: Diagnosis, evidence: Evidence, **more: Any) -> dict[str, Any]:
    document = diagnosis_document(d, inputs_of(d, **more), evidence)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    return document


def _nothing(d: Diagnosis) -> Diagnosis:
    return replace(
        d,
        verdict="none",
        effects=(),
        extended=None,
        extended_score=None,
        noise_floor=None,
        error_removed=None,
        ci95=None,
        after=None,
        white=True,
        depends_on=(),
    )


def _unexplained(d: Diagnosis) -> Diagnosis:
    left = (
        Dependence("torque", "direction", 0.4, 0.02, 0.03),
        Dependence("torque", "speed", 0.2, 0.015, 0.02),
        Dependence("voltage", "frequency", 0.1, 0.3, 0.01, {"frequency_hz": 12.5}),
        Dependence("torque", "angle", 0.1, 0.01, 0.01, {"harmonic": 14.0}),
        Dependence("torque", "step", 0.1, 0.01, 0.01, {"time_s": 3.25}),
    )
    return replace(_nothing(d), verdict="unexplained", white=False, depends_on=left)


def _without_extension(e: Evidence) -> Evidence:
    return replace(e, free_runs=tuple((before, None) for before, _ in e.free_runs), asked=None, left=None)


def test_found_has_every_key_of_the_contract(found: tuple[Diagnosis, Evidence]) -> None:
    document = document_of(*found)
    assert document.keys() >= KEYS
    assert (document["schema"], document["verdict"]) == (1, "found")
    (effect,) = document["effects"]
    assert effect.keys() >= {"name", "cause", "equation", "parameters", "gain", "equivalent"}
    assert effect["name"] == "cogging_torque"
    assert effect["cause"] == effects_by_name()["cogging_torque"].cause
    assert effect["parameters"]["Tcog"]["value"] == pytest.approx(0.2, rel=0.02)
    assert effect["parameters"]["n_cog"] == {
        "value": 7.0,
        "std": None,
        "unit": "1",
        "at_bound": False,
        "status": "searched",
    }
    for model in ("baseline", "extended"):
        assert document[model].keys() >= {"parameters", "heldout_rmse", "heldout_nrmse"}
        assert document[model]["heldout_rmse"].keys() == {"current_A", "position_rad", "velocity_rad_s"}
    assert document["extended"]["heldout_nrmse"] < document["baseline"]["heldout_nrmse"]
    assert document["gain"].keys() == {"error_removed", "ci95", "measured_on"}
    b, e, n = document["baseline"]["heldout_nrmse"], document["extended"]["heldout_nrmse"], document["noise_floor"]
    assert document["gain"]["error_removed"] == pytest.approx((b**2 - e**2) / (b**2 - n**2))
    assert document["gain"]["measured_on"] == document["measured_on"]
    assert all(c.keys() >= {"name", "heldout_nrmse", "delta_bic"} for c in document["candidates"])
    assert document["remaining"].keys() >= {"white", "depends_on"}


def test_what_is_left_is_smoothed_like_what_was_missing(found: tuple[Diagnosis, Evidence]) -> None:
    """By its own intensities a model that errs a little everywhere misses nothing at all."""
    d, evidence = found
    assert d.after is not None
    assert evidence.left is not None
    calm = replace(d, after=replace(d.after, series={name: 0.0 * x for name, x in d.after.series.items()}))
    again = gather_evidence(calm)
    assert again.left is not None
    assert again.left.levels == d.before.levels
    row = document_of(calm, again)["missing"]["torque"]
    assert 0 < row["after_rms"] < 0.5 * row["before_rms"]
    assert row["after_rms"] == pytest.approx(float(np.sqrt(np.mean(again.left.series["torque"] ** 2))))


def test_what_is_missing_over_the_speed_goes_with_what_was_found(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    curves = document_of(d, evidence)["missing"]["torque"]["over_speed"]
    assert curves["unit"] == "rad/s"
    missing = evidence.asked or d.before
    spread = {}
    for name in ("before", "after"):
        speed = np.array(curves[name]["speed"])
        value = np.array([np.nan if y is None else y for y in curves[name]["value"]])
        assert len(speed) == len(value) > 20 and np.all(np.diff(speed) > 0)
        spread[name] = np.nanstd(value)
    assert spread["after"] < 0.5 * spread["before"] < 0.5 * np.std(missing.series["torque"])
    lowest, highest = np.quantile(missing.states["velocity_rad_s"], [0.0, 1.0])
    assert lowest <= curves["before"]["speed"][0] < 0 < curves["before"]["speed"][-1] <= highest


def test_intensities_are_those_of_a_motor_of_that_size(found: tuple[Diagnosis, Evidence]) -> None:
    """Without a current two fits may have torques of any size."""
    d, _ = found
    assert d.after is not None
    weak = replace(d, after=replace(d.after, size={name: 0.1 * size for name, size in d.after.size.items()}))
    again = gather_evidence(weak)
    assert again.asked is not None
    assert again.left is not None
    assert again.asked.levels != d.before.levels
    assert again.left.levels == again.asked.levels
    for name, walk in d.before.levels.walk.items():
        share = 0.1 * d.after.size[name] / d.before.size[name]
        assert again.asked.levels.walk[name] >= share**2 * walk
    for channel, var in d.after.levels.channel_var.items():
        assert again.asked.levels.channel_var[channel] <= var


def test_what_cannot_be_compared_is_not_drawn_together(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    assert evidence.asked is not None
    other = replace(evidence.asked, levels=replace(evidence.asked.levels, input_var=1.0))
    for asked, first in ((evidence.asked, "baseline"), (other, "effects left out")):
        figures = missing_figures(d, replace(evidence, asked=asked), ())
        assert {f.lines[0].name for f in figures if isinstance(f, TimeSeries | Spectrum)} == {first}


def test_captions_say_which_models_motor_works_with_how_much(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    assert evidence.left is not None
    for factor, words in ((2.0, ["(baseline)", "(extended)"]), (1.0, [])):
        left = replace(evidence.left, size={name: factor * size for name, size in d.before.size.items()})
        figures = missing_figures(d, replace(evidence, left=left), ())
        captions = [f.caption for f in figures if isinstance(f, TimeSeries)]
        assert captions
        for caption in captions:
            assert [word for word in ("(baseline)", "(extended)") if word in caption] == words


@pytest.mark.parametrize(
    ("removed", "ci95", "words"),
    [
        (1.04, (1.01, 1.07), "removes 104 % (95 %: 101 % … 107 %) of"),
        (-0.1, (-0.4, 0.2), "removes -10 % (95 %: -40 % … 20 %) of"),
        (0.8, (0.5, float("inf")), "removes 80 % (95 %: at least 50 %) of"),
    ],
)
def test_a_gain_is_shown_as_it_is(
    found: tuple[Diagnosis, Evidence], removed: float, ci95: tuple[float, float], words: str
) -> None:
    d, evidence = found
    document = document_of(replace(d, error_removed=removed, ci95=ci95), evidence)
    assert document["gain"]["error_removed"] == removed
    assert words in " ".join(" ".join(diagnosis_lines(document)).split())


def test_a_gain_of_the_part_that_decided_says_so(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    document = document_of(replace(d, measured_on="choosing"), evidence)
    assert document["gain"]["measured_on"] == "choosing"
    text = " ".join(" ".join(diagnosis_lines(document)).split())
    assert "On the validation data this removes" in text
    assert "too short to hold a part out" in text
    assert "held out from fit and choice" not in text


def test_none_has_neither_gain_nor_extended_model(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    document = document_of(_nothing(d), _without_extension(evidence))
    assert document["effects"] == document["remaining"]["depends_on"] == []
    assert document["gain"] is document["extended"] is document["toml"] is None
    assert document["remaining"]["white"] is True
    assert diagnosis_lines(document)[0].startswith("Nothing is missing: the linear motor explains")


def test_unexplained_says_what_it_follows_in_the_contracts_words(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    document = document_of(_unexplained(d), _without_extension(evidence))
    assert document["remaining"]["depends_on"] == ["speed", "frequency", "angle", "time"]
    assert document["effects"] == []
    assert document["gain"] is document["extended"] is None
    details = {x["on"]: x for x in document["remaining"]["dependences"]}
    assert details["frequency"]["detail"] == {"frequency_hz": 12.5}
    assert (details["frequency"]["unit"], details["angle"]["unit"]) == ("V", "N·m")
    text = " ".join(" ".join(diagnosis_lines(document)).split())
    assert text.startswith("Unexplained: ")
    for words in ("12.5 Hz", "14 times a turn", "at 3.25 s", "3 % of the working torque"):
        assert words in text


def test_numbers_that_are_none_become_null(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    bad = replace(
        d,
        noise_floor=float("nan"),
        error_removed=float("-inf"),
        ci95=(float("nan"), 1.0),
        candidates=tuple(replace(c, nrmse=float("inf"), delta_bic=float("nan")) for c in d.candidates),
        effects=(NamedEffect("cogging_torque", float("nan"), ()),),
    )
    document = document_of(bad, evidence)
    assert document["gain"] == {"error_removed": None, "ci95": [None, 1.0], "measured_on": d.measured_on}
    assert document["candidates"][0]["heldout_nrmse"] is None
    text = "\n".join(diagnosis_lines(document)).lower()
    assert "nan" not in text
    assert "inf " not in text
    html = render_report(diagnosis_report(bad, evidence, document, make_provenance(["diagnose"])))
    assert "The gain over the linear motor could not be measured" in html


def test_what_cannot_be_told_apart_comes_with_an_experiment(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    tied = replace(d, effects=(NamedEffect("cogging_torque", 0.9, ("torque_ripple", "encoder_eccentricity")),))
    document = document_of(tied, evidence)
    assert document["effects"][0]["equivalent"] == [["torque_ripple"], ["encoder_eccentricity"]]
    text = " ".join(" ".join(diagnosis_lines(document)).split())
    assert "cannot tell it from torque_ripple: turn slowly" in text
    assert "cannot tell it from encoder_eccentricity: let it coast" in text


def test_every_pair_of_effects_has_an_experiment() -> None:
    texts = {experiment(a, [b]) for a in effects_by_name() for b in effects_by_name() if a != b}
    assert all(text.endswith(".") and len(text) > 30 for text in texts)
    one, other = "brush_voltage_drop", "coulomb_friction"
    assert experiment(one, [other]) == experiment(other, [one])
    assert experiment("cogging_torque_2", ["torque_ripple"]) == experiment("cogging_torque", ["torque_ripple"])


def test_differences_between_captures_are_listed(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    own = OwnModel("folder/day2.csv", {"position_rad": 0.5}, {"position_rad": 0.02})
    apart = (Spread("B", (0.51, 0.53), (0.001, 0.002)),)
    spread = replace(d, captures=(d.captures[0],) * 2, differences=apart, own_models=(own,))
    both = replace(evidence, free_runs=evidence.free_runs * 2)
    document = document_of(spread, both)
    assert document["differences"] == [
        {"name": "B", "unit": "N·m·s/rad", "values": [0.51, 0.53], "stds": [0.001, 0.002]}
    ]
    text = "\n".join(diagnosis_lines(document))
    assert "B = 0.51 ± 0.001, 0.53 ± 0.002 N·m·s/rad   (3.9 % higher in the last than in the first)" in text
    assert "day2.csv: position_rad 0.5 → 0.02 with its own values" in text
    (section,) = difference_sections(document)
    html = render_report(Report("", "", (section,), make_provenance(["diagnose"])))
    assert "What differs between the captures" in html
    assert "0.5300 ± 0.0020" in html
    assert "3.9 % higher" in html


def _as_config(toml: str) -> DriveConfig:
    return parse_config(tomllib.loads('[[drive]]\nname = "axis1"\n' + toml)).drive[0]


def test_the_lines_of_toml_are_a_configuration(found: tuple[Diagnosis, Evidence], tmp_path: Path) -> None:
    document = document_of(*found)
    path = tmp_path / "drive.toml"
    path.write_text('[[drive]]\nname = "axis1"\n' + document["toml"])
    drive = load_config(path).drive[0]
    assert drive.model == ("cogging_torque",)
    assert drive.nominal["n_cog"] == 7
    assert drive.nominal["Tcog"] == pytest.approx(document["effects"][0]["parameters"]["Tcog"]["value"], rel=1e-5)


@pytest.mark.parametrize("bound", ["lower", "upper"])
def test_values_at_a_bound_stay_within_it(found: tuple[Diagnosis, Evidence], bound: str) -> None:
    d, evidence = found
    assert d.extended is not None
    value = float(getattr(parameter_table()["Tcog"], bound)) * (1 + 1e-9 if bound == "upper" else 1 - 1e-9)
    parameters = {**d.extended.parameters, "Tcog": replace(d.extended.parameters["Tcog"], value=value)}
    at_bound = replace(d, extended=replace(d.extended, parameters=parameters))
    assert _as_config(document_of(at_bound, evidence)["toml"]).nominal["Tcog"] > 0


def test_what_the_data_do_not_determine_has_its_nominal_value_or_none(found: tuple[Diagnosis, Evidence]) -> None:
    d, evidence = found
    assert d.extended is not None
    lost = replace(d.extended.parameters["Tcog"], value=123.0, std=None, status="undetermined")
    open_fit = replace(d.extended, parameters={**d.extended.parameters, "Tcog": lost})
    document = document_of(replace(d, extended=open_fit), evidence)
    assert document["effects"][0]["parameters"]["Tcog"]["value"] is None
    assert "# not determined by these data: Tcog" in document["toml"]
    assert "123" not in document["toml"]
    given = document_of(replace(d, extended=open_fit), evidence, nominal={"Tcog": 0.25})
    assert given["effects"][0]["parameters"]["Tcog"]["value"] == 0.25


@pytest.mark.parametrize("change", [_nothing, _unexplained, lambda d: d])
def test_every_verdict_has_a_report(
    found: tuple[Diagnosis, Evidence], change: Callable[[Diagnosis], Diagnosis]
) -> None:
    d, evidence = found
    d = change(d)
    evidence = evidence if d.extended is not None else _without_extension(evidence)
    html = render_report(diagnosis_report(d, evidence, document_of(d, evidence), make_provenance(["diagnose"])))
    for words in ("Missing torque over time", "Missing voltage over angle", "What was tried"):
        assert words in html
    assert ("For the daemon" in html) == (d.verdict == "found")


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.93, "93 %"),
        (0.994, "99.4 %"),
        (0.9997, "99.97 %"),
        (0.9999999, "100 %"),
        (1.0, "100 %"),
        (0.0042, "0.42 %"),
        (0.0, "0 %"),
        (-0.3, "-30 %"),
    ],
)
def test_percentages_have_the_digits_that_matter(share: float, text: str) -> None:
    assert percent(share) == text


def test_symbols_are_characters() -> None:
    texts = {p.name: symbol_text(p.symbol) for p in parameter_table().values()}
    assert (texts["Tc"], texts["ws"], texts["Tc_neg"], texts["n_cog_2"]) == ("T_c", "ωₛ", "T_c⁻", "n_cog,2")
    assert all(not set(text) & set("\\{}") for text in texts.values())
