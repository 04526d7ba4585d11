"""EST.csv: its columns, exact numbers, empty cells, and that it appears whole or not at all."""

from __future__ import annotations

import csv
import gzip
import math
from collections.abc import Mapping
from pathlib import Path

import pytest

from servo_daemon.commands.replay.estimates_csv import EstimatesWriter, parameter_order
from servo_daemon.errors import BadInputError
from servo_daemon.published.snapshot import Estimate, EstimatorView, ParameterEstimate, Status


def parameter(
    name: str, value: float | None, std: float | None = None, status: Status = "tracking"
) -> ParameterEstimate:
    return ParameterEstimate(name, value, std, "unit", None, status)


def estimate(
    time_s: float, *parameters: ParameterEstimate, estimators: Mapping[str, EstimatorView] | None = None
) -> Estimate:
    return Estimate(time_s, 1, None, (), parameters, {}, estimators or {}, {})


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as lines:
        return list(csv.DictReader(lines))


def test_columns_in_the_order_of_the_contract() -> None:
    assert parameter_order(["J_d", "Tc", "B", "J", "Tg", "K", "L", "R", "phi_g"]) == (
        *("R", "L", "K", "J", "B"),
        *("Tc", "Tg", "phi_g", "J_d"),
    )


def test_header_and_rows(tmp_path: Path) -> None:
    path = tmp_path / "EST.csv"
    time_s = 1700000000.1 + 1 / 3
    views = {
        "ekf": EstimatorView({"R": (1.25, 0.5)}, status={"R": "tracking"}),
        "rls": EstimatorView({"R": (None, None), "Tc": (2.0, None)}),
    }
    with EstimatesWriter(path, ["Tc", "R"], ["rls", "ekf", "grnn"]) as writer:
        writer.write(estimate(0.1, parameter("R", None, None, "estimating"), parameter("Tc", 0.02, 1e-5)))
        writer.write(estimate(time_s, parameter("Tc", math.nan, math.inf, "invalid"), estimators=views))
    assert path.read_text() == (
        "time_s,R,R_std,R_status,Tc,Tc_std,Tc_status,ekf_R,ekf_R_std,ekf_R_status,ekf_Tc,ekf_Tc_std,ekf_Tc_status,"
        "rls_R,rls_R_std,rls_R_status,rls_Tc,rls_Tc_std,rls_Tc_status,"
        "grnn_R,grnn_R_std,grnn_R_status,grnn_Tc,grnn_Tc_std,grnn_Tc_status\n"
        "0.1,,,estimating,0.02,1e-05,tracking,,,,,,,,,,,,,,,,,,\n"
        f"{time_s!r},,,,,,invalid,1.25,0.5,tracking,,,,,,,2.0,,,,,,,,\n"
    )
    (_, row) = table(path)
    assert float(row["time_s"]) == time_s


def test_nothing_is_lost_silently(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown estimators"):
        EstimatesWriter(tmp_path / "a.csv", ["R"], ["rsl"])
    writer = EstimatesWriter(tmp_path / "a.csv", ["R"], ["ekf"])
    with pytest.raises(ValueError, match="no columns for Tc, rls"):
        writer.write(estimate(0.0, parameter("Tc", 1.0), estimators={"rls": EstimatorView({})}))
    with pytest.raises(ValueError, match="no columns for ekf_Tc"):
        writer.write(estimate(0.0, estimators={"ekf": EstimatorView({"Tc": (1.0, None)})}))
    writer.discard()
    assert list(tmp_path.iterdir()) == []


def test_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "EST.csv"

    def fail() -> None:
        with EstimatesWriter(path, ["R"]) as writer:
            writer.write(estimate(0.0, parameter("R", 1.0)))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list(tmp_path.iterdir()) == []
    with EstimatesWriter(path, ["R"]) as writer:
        assert not path.exists()
    writer.close()
    assert path.read_text() == "time_s,R,R_std,R_status\n"
    with pytest.raises(BadInputError, match="cannot be written"):
        EstimatesWriter(tmp_path / "none" / "EST.csv", ["R"])


def test_equal_estimates_give_equal_bytes_compressed_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, hour in (("a.csv.gz", 1e9), ("b.csv.gz", 2e9)):
        monkeypatch.setattr("time.time", lambda hour=hour: hour)
        with EstimatesWriter(tmp_path / name, ["R"]) as writer:
            for k in range(100):
                writer.write(estimate(k / 10, parameter("R", math.sqrt(k), 1 / (k + 1))))
    data = (tmp_path / "a.csv.gz").read_bytes()
    assert data == (tmp_path / "b.csv.gz").read_bytes()
    rows = gzip.decompress(data).decode().splitlines()
    assert [float(row.split(",")[1]) for row in rows[1:]] == [math.sqrt(k) for k in range(100)]


def test_a_name_of_another_format_is_refused(tmp_path: Path) -> None:
    for name in ("est.parquet", "est.XLSX", "est.xyz", "est.csv.zip"):
        with pytest.raises(BadInputError, match=rf"{name}: estimates are written as CSV"):
            EstimatesWriter(tmp_path / name, ["R"])
    assert not list(tmp_path.iterdir())
