"""`servo-daemon tune`: documents, files, and one line for what cannot be."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.api.schemas import tuning as tuning_schemas
from servo_daemon.commands.shared.common import parse_fix
from servo_daemon.commands.tune.command import parse_tolerance
from servo_daemon.config import load_config
from servo_daemon.errors import BadInputError
from servo_daemon.simulate import PAPER_MOTOR
from tests.unit.commands.test_cli import Run, capture, run  # noqa: F401  (fixtures)

FIX = "R=0.4937,L=2.2769e-3,K=0.30628,J=0.009751,B=0.51141"
DESIGNS = ("speed_pi", "position_pid", "lqr")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "servo.toml"
    nominal = "\n".join(f"{name} = {value}" for name, value in PAPER_MOTOR.items())
    path.write_text(
        f"""[[drive]]
driver = "serial"
[drive.nominal]
{nominal}
[drive.limits]
voltage_V = 24.0
[drive.load]
counts_per_rev = 4096
[drive.controller]
rate_hz = 2000
bandwidth_hz = 3.0
speed_kp_V_s_rad = 1.2
speed_ki_V_rad = 84.0
speed_filter_hz = 120.0
""",
        encoding="utf-8",
    )
    return path


def test_a_capture_tells_the_motor_and_its_worst_case(run: Run, capture: Path) -> None:  # noqa: F811
    result = run("tune", capture, "--bandwidth-hz", "2.5", "--json")
    assert result.code == 0
    document = result.document
    assert document["capture"] == str(capture) and document["rate_source"] == "measured"
    assert document["region"].startswith("95% ellipsoid of the logarithms of R, L, K, J, B")
    for name, true in PAPER_MOTOR.items():
        p = document["parameters"][name]
        assert p["source"] == "capture" and abs(p["value"] - true) < 5 * p["std"]
    for key in DESIGNS:
        design = document["designs"][key]
        assert not design["capped"] and design["response"]["bandwidth_hz"] == pytest.approx(2.5, rel=1e-3)
        worst, at_estimate = design["worst"], design["margins"]
        assert 30 < worst["phase_margin_deg"] <= at_estimate["phase_margin_deg"]
        assert at_estimate["sensitivity_peak"] <= worst["sensitivity_peak"] < 2
    assert document["in_use"] is None


def test_the_document_is_the_one_of_the_rest_api(run: Run, config: Path) -> None:  # noqa: F811
    document = run("tune", "--config", config, "--tolerance", "15%", "--json").document
    del document["capture"]
    tuning_schemas.TuningDocument.model_validate(document | {"time": None, "samples": 0, "margin_low": None})


def test_a_config_alone_gives_nominal_gains_without_a_worst_case(run: Run, config: Path) -> None:  # noqa: F811
    document = run("tune", "--config", config, "--json").document
    assert document["rate_hz"] == 2000 and document["rate_source"] == "configured"
    assert document["region"] is None and document["designs"]["lqr"]["worst"] is None
    assert {p["source"] for p in document["parameters"].values()} == {"nominal"}
    assert document["asked"]["bandwidth_hz"] == 3.0, "as the configuration asks"
    assert document["in_use"]["nominal"] == document["in_use"]["margins"] and document["in_use"]["weak"] is False
    assert document["designs"]["speed_pi"]["largest_linear_step"] > 0
    assert document["designs"]["speed_pi"]["voltage_per_count_V"] > 0


def test_a_tolerance_gives_one(run: Run, config: Path) -> None:  # noqa: F811
    narrow = run("tune", "--config", config, "--tolerance", "5%", "--json").document
    wide = run("tune", "--config", config, "--tolerance", "R=5%,L=5%,K=5%,J=30%,B=5%", "--json").document
    assert "J ± 30 %" in wide["region"]
    peaks = [d["in_use"]["worst"]["sensitivity_peak"] for d in (narrow, wide)]
    assert narrow["in_use"]["margins"]["sensitivity_peak"] < peaks[0] < peaks[1]


def test_the_table_names_everything(run: Run, config: Path) -> None:  # noqa: F811
    result = run("tune", "--config", config, "--fix", "J=0.02", "--settling-s", "0.4")
    assert result.code == 0
    for word in ("J = 0.02 kg·m²  fixed", "PI speed loop", "PID position loop", "LQR", "Gains in use", "margins:"):
        assert word in result.out
    assert result.out.count("settles in 0.4 s") == 3 and "not claimed" in result.out


def test_gains_that_are_unstable_are_told(run: Run, config: Path) -> None:  # noqa: F811
    config.write_text(
        config.read_text(encoding="utf-8").replace("kp_V_s_rad = 1.2", "kp_V_s_rad = 60.0"), encoding="utf-8"
    )
    result = run("tune", "--config", config, "--json")
    assert result.code == 0, "a verdict, no failure"
    in_use = result.document["in_use"]
    assert in_use["margins"]["stable"] is False and in_use["margins"]["phase_margin_deg"] is None
    assert in_use["weak"] is True and in_use["warnings"] == ["the loop is unstable"] and in_use["response"] is None
    assert "WARNING: the loop is unstable" in run("tune", "--config", config).out


def test_what_is_out_of_reach_is_capped_and_says_why(run: Run) -> None:  # noqa: F811
    document = run("tune", "--fix", FIX, "--rate-hz", "1000", "--bandwidth-hz", "90", "--json").document
    design = document["designs"]["speed_pi"]
    assert design["capped"] and design["response"]["bandwidth_hz"] < 90
    assert "at most" in design["reason"] and "the delay 1 ms" in design["reason"]
    quick = run("tune", "--fix", FIX, "--rate-hz", "1000", "--settling-s", "0.011", "--json").document
    assert "settles after" in quick["designs"]["position_pid"]["reason"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "no gains without R, L, K, J, B"),
        (("--fix", "R=1,K=0.05"), "no gains without L, J, B"),
        (("none.csv",), "none.csv"),
        (("--config", "none.toml"), "none.toml"),
        (("--fix", FIX, "--bandwidth-hz", "400"), "too fast for 1000 samples a second: ask for at most 100 Hz"),
        (("--fix", FIX, "--settling-s", "1e-4"), "ask for at least 0.01 s"),
        (("--fix", FIX, "--bandwidth-hz", "1e-9"), "too slow for 1000 samples a second: ask for at least 0.01 Hz"),
        (("--fix", FIX, "--settling-s", "1e9"), "too slow for 1000 samples a second: ask for at most 100 s"),
        (("--fix", FIX, "--bandwidth-hz", "-3"), "positive"),
        (("--fix", FIX, "--bandwidth-hz", "nan"), "positive"),
        (("--fix", FIX, "--bandwidth-hz", "3", "--settling-s", "1"), "not allowed with"),
        (("--fix", FIX, "--rate-hz", "0"), "--rate-hz"),
        (("--fix", FIX, "--delay-samples", "50"), "--delay-samples"),
        (("--fix", "X=1"), "unknown parameter in 'X=1'"),
        (("--fix", "R=big"), "R = 'big' is not a number"),
        (("--fix", "R=-1"), "outside"),
        (("--fix", FIX, "--tolerance", "10"), "not of the form 10%"),
        (("--fix", FIX, "--tolerance", "1.2.3%"), "'1.2.3%' is not of the form 10%"),
        (("--fix", FIX, "--tolerance", "150%"), "between 0 and 100 %"),
        (("--fix", FIX, "--tolerance", "Tc=10%"), "unknown parameter"),
    ],
)
def test_bad_input_is_one_line(run: Run, words: tuple[str, ...], says: str) -> None:  # noqa: F811
    result = run("tune", *words, "--json")
    assert result.code == 2
    assert says in result.document["error"] and "\n" not in result.document["error"]


def without(capture: Path, column: str, path: Path) -> Path:  # noqa: F811
    """The same capture less a column."""
    lines = [x for x in capture.read_text(encoding="utf-8").splitlines() if not x.startswith("#")]
    rows = [line.split(",") for line in lines]
    keep = [k for k, name in enumerate(rows[0]) if name != column]
    path.write_text("\n".join(",".join(row[k] for k in keep) for row in rows), encoding="utf-8")
    return path


def test_without_a_current_sensor_gains_follow_from_what_is_determined(
    run: Run,  # noqa: F811
    capture: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    blind = without(capture, "current_A", tmp_path / "blind.csv")
    document = run("tune", blind, "--bandwidth-hz", "2.5", "--json").document
    assert all(p["value"] is None and p["std"] is None for p in document["parameters"].values())
    assert document["designs"].keys() == {"speed_pi", "position_pid"}  # an LQR would need a measured current
    known = run("tune", "--fix", FIX, "--rate-hz", "1000", "--bandwidth-hz", "2.5", "--json").document
    for key, design in document["designs"].items():
        for name, gain in design["gains"].items():
            assert gain == pytest.approx(known["designs"][key]["gains"][name], rel=0.03)
        assert design["worst"]["phase_margin_deg"] < design["margins"]["phase_margin_deg"]
        assert design["worst"]["phase_margin_deg"] > design["margins"]["phase_margin_deg"] - 5.0
        assert all(motor == {} for motor in design["worst"]["at"].values())
    gain, slow, fast = document["answer"]
    assert abs(gain["value"] - 0.30628 / (0.4937 * 0.51141 + 0.30628**2)) < 4 * gain["std"]
    assert {c["unit"] for c in (gain, slow, fast)} == {"rad/(s·V)", "s", "s²"}
    text = run("tune", blind).out
    assert "K/(B R + K²) =" in text and " R = " not in text


def test_without_a_current_sensor_given_values_complete_the_motor(run: Run, capture: Path, tmp_path: Path) -> None:  # noqa: F811
    blind = without(capture, "current_A", tmp_path / "blind.csv")
    result = run("tune", blind, "--fix", "R=0.4937,L=2.2769e-3,K=0.30628", "--json")
    assert result.code == 0
    assert result.document["parameters"]["R"]["source"] == "fixed" and "R" in result.document["not_in_region"]
    assert result.document["designs"].keys() == set(DESIGNS)


def test_what_must_be_given_is_said(run: Run, capture: Path, tmp_path: Path) -> None:  # noqa: F811
    """Ratios to K without a voltage; K²/J and J/B without a motion."""
    no_voltage = without(capture, "voltage_V", tmp_path / "no_voltage.csv")
    result = run("tune", no_voltage, "--json")
    assert result.code == 2 and "no_voltage.csv" in result.document["error"]
    assert "--fix R=…,L=…,K=… " in result.document["error"]
    assert run("tune", no_voltage, "--fix", "R=0.4937,L=2.2769e-3,K=0.30628", "--json").code == 0
    torque = tmp_path / "torque.csv"
    torque.write_text(no_voltage.read_text().replace("current_A", "torque_Nm"))
    assert "--fix R=…,L=…,K=… " in run("tune", torque, "--json").document["error"]
    still = without(without(capture, "position_rad", tmp_path / "a.csv"), "velocity_rad_s", tmp_path / "still.csv")
    result = run("tune", still, "--json")
    assert result.code == 2 and "--fix K=… " in result.document["error"]


def test_the_files(run: Run, config: Path, tmp_path: Path) -> None:  # noqa: F811
    folder = tmp_path / "deep" / "out"
    result = run("tune", "--config", config, "--out", folder, "--json")
    assert result.code == 0
    assert json.loads((folder / "tuning.json").read_text(encoding="utf-8")) == result.document
    steps = [f"step_{key}.csv" for key in (*DESIGNS, "in_use")]
    assert sorted(p.name for p in folder.iterdir()) == sorted(["tuning.json", "controller.toml", "bode.csv", *steps])
    for name in steps:
        with (folder / name).open(encoding="utf-8") as file:
            *_, last = csv.DictReader(file)
        shown = "position_rad" if name in ("step_position_pid.csv", "step_lqr.csv") else "velocity_rad_s"
        assert float(last[shown]) == pytest.approx(1.0, abs=1e-3)
    table = np.genfromtxt(folder / "bode.csv", delimiter=",", names=True)
    margins = result.document["designs"]["lqr"]["margins"]
    at = np.interp(math.log(margins["crossover_hz"]), np.log(table["frequency_hz"]), table["lqr_gain_dB"])
    assert at == pytest.approx(0.0, abs=0.02)
    pasted = tmp_path / "pasted.toml"
    pasted.write_text("[[drive]]\n" + (folder / "controller.toml").read_text(encoding="utf-8"), encoding="utf-8")
    controller = load_config(pasted, {}).drive[0].controller
    gains = result.document["designs"]["position_pid"]["gains"]
    assert controller.position_kp_1_s == pytest.approx(gains["position_kp_1_s"], rel=1e-5)
    assert controller.rate_hz == 2000


def test_a_folder_that_cannot_be_made_is_one_line(run: Run, tmp_path: Path) -> None:  # noqa: F811
    (tmp_path / "file").write_text("", encoding="utf-8")
    result = run("tune", "--fix", FIX, "--out", tmp_path / "file" / "deeper", "--json")
    assert result.code == 2 and "--out" in result.document["error"]


def test_gains_pasted_into_the_config_have_the_margins_of_the_design(run: Run, config: Path, tmp_path: Path) -> None:  # noqa: F811
    document = run("tune", "--config", config, "--json").document
    design = document["designs"]["position_pid"]
    text = config.read_text(encoding="utf-8").split("[drive.controller]")[0] + "[drive.controller]\nrate_hz = 2000\n"
    config.write_text(
        text + "".join(f"{key} = {value!r}\n" for key, value in design["gains"].items()), encoding="utf-8"
    )
    again = run("tune", "--config", config, "--json").document["in_use"]
    assert again["margins"] == pytest.approx(design["margins"])
    assert again["response"] == pytest.approx(design["response"])


def test_texts_are_understood() -> None:
    assert parse_fix("R=1.5, Tc = 0.02,") == {"R": 1.5, "Tc": 0.02}
    assert parse_tolerance("10 %") == dict.fromkeys("RLKJB", pytest.approx(0.1))
    assert parse_tolerance("10%,J=50%")["J"] == 0.5
    with pytest.raises(BadInputError):
        parse_tolerance("0%")
