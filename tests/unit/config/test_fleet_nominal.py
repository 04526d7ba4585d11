"""`[drive.nominal] from`: what drives of the same type have in common."""

from __future__ import annotations

from pathlib import Path

import pytest

from servo_daemon.config import parse_config
from servo_daemon.errors import ConfigError
from servo_daemon.fleet.prior_file import PriorRow, spread_of, write_prior

ROWS = (PriorRow("R", "Ω", 1.2, 0.01, 0.05, True, 40), PriorRow("K", "N·m/A", 0.06, 1e-4, 0.03, True, 40))


def test_a_fleet_gives_start_values_and_what_stands_beside_it_goes_before(tmp_path: Path) -> None:
    path = tmp_path / "fleet.parquet"
    write_prior(path, ROWS)
    config = parse_config({"drive": [{"nominal": {"from": str(path), "R": 1.5, "J": 1e-4}}]})
    assert dict(config.drive[0].nominal) == {"R": 1.5, "K": 0.06, "J": 1e-4}


def test_what_is_no_fleets_prior_is_named(tmp_path: Path) -> None:
    path = tmp_path / "other.parquet"
    path.write_bytes(b"PAR1")
    with pytest.raises(ConfigError, match=r"nominal: from: .*other\.parquet"):
        parse_config({"drive": [{"nominal": {"from": str(path)}}]})


def test_training_draws_wide_enough_for_ageing() -> None:
    assert spread_of(ROWS) == 2.0
    assert spread_of((PriorRow("B", "N·m·s/rad", 1e-5, 1e-6, 0.5, True, 40),)) > 4.0
