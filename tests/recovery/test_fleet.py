"""`fleet` from captures of an independent generator: on processes, with one killed, resumed, and loaded again."""

from __future__ import annotations

import json
import os
import platform
import resource
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from servo_daemon import cli
from servo_daemon.fleet.cluster import cluster, results
from servo_daemon.fleet.units import Unit
from servo_daemon.learning.model.model_file import load_model
from tests.can_tools import wait_for
from tests.recovery.many_drives import draw, record
from tests.recovery.worker_work import deadly, page_faults

dask = pytest.importorskip("dask", reason="the extra dask is not installed")
pytest.importorskip("distributed", reason="the extra dask is not installed")

DRIVES = 9


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    for k in range(DRIVES):
        motor = draw(k)
        motor = replace(motor, R=1.5 * motor.R) if k == 3 else motor
        record(folder / f"axis{k}.csv", motor, seconds=1.0, seed=k)
    (folder / "broken.csv").write_text("time_s,voltage_V\n0,1\n")
    return folder


def fleet(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert cli.main(["fleet", *words, "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    return document


@pytest.mark.slow
def test_a_fleet_is_fitted_goes_on_where_it_stopped_and_names_the_stranger(
    captures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = fleet(capsys, "fit", str(captures), "--out", str(tmp_path), "--workers", "2")
    assert told["drives"] == DRIVES
    assert [row["drive"] for row in told["failed"]] == ["broken"] and "broken.csv" in told["failed"][0]["error"]
    assert [row["drive"] for row in told["strangers"]] == ["axis3"]
    common = {row["parameter"]: row for row in told["common"]}
    assert common["K"]["value"] == pytest.approx(0.06, rel=0.1)
    assert all(p.is_file() for p in (tmp_path / n for n in ("report.html", "drives.parquet", "fleet.parquet")))

    kept = sorted((tmp_path / "results").iterdir())
    before = {path: path.stat().st_mtime_ns for path in kept}
    kept[0].unlink()
    assert fleet(capsys, "fit", str(captures), "--out", str(tmp_path), "--workers", "1")["common"] == told["common"]
    after = {path: path.stat().st_mtime_ns for path in sorted((tmp_path / "results").iterdir())}
    assert [path for path in kept if before[path] != after[path]] == [kept[0]]

    # The learned model of this type: no drive is fitted once more for it.
    told = fleet(capsys, "train", str(captures), "--out", str(tmp_path), "--motors", "130")
    assert 100 <= told["model"]["motors"] <= 130
    assert load_model(tmp_path / "model.zip").feature_names
    assert after == {path: path.stat().st_mtime_ns for path in sorted((tmp_path / "results").iterdir())}


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_fleet_is_diagnosed_though_a_worker_dies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The whole command on two drives, one with friction; the processes are killed while one computes."""
    folder, out = tmp_path / "captures", tmp_path / "fleet"
    for k in range(2):
        effects = {"coulomb_friction": {"Tc": 0.035}} if k == 1 else None
        record(folder / f"axis{k}.csv", draw(k), seconds=5.0, seed=k, effects=effects)
    killed: list[int] = []

    def kill() -> None:
        wait_for(lambda: any(out.glob("results/*.json")), "the first result", limit_s=300.0)
        for child in workers():
            os.kill(child, signal.SIGKILL)
            killed.append(child)

    killer = threading.Thread(target=kill)
    killer.start()
    told = fleet(capsys, "diagnose", str(folder), "--out", str(out), "--workers", "2", "--budget", "60")
    killer.join()
    assert killed
    assert (told["drives"], told["failed"], told["causes"]) == (2, [], {"coulomb_friction": 1})
    rows = pq.read_table(out / "drives.parquet").to_pylist()
    assert {row["drive"]: row["effects"] for row in rows} == {"axis0": "", "axis1": "coulomb_friction"}
    values = {(r["drive"], r["parameter"]): r["value"] for r in pq.read_table(out / "parameters.parquet").to_pylist()}
    assert values["axis1", "Tc"] == pytest.approx(0.035, rel=0.05)
    assert "1 of 2: axis1" in (out / "report.html").read_text(encoding="utf-8")


def workers() -> list[int]:
    """Processes of the cluster that this process has started."""
    children = Path(f"/proc/{os.getpid()}/task").glob("*/children")
    found = {int(pid) for path in children for pid in path.read_text().split()}
    return [pid for pid in found if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


@pytest.mark.slow
def test_a_worker_that_dies_costs_no_result_but_that_of_what_kills_it(tmp_path: Path) -> None:
    units = [Unit(name, (), ()) for name in ("a", "once", "b", "always", "c")]
    with cluster(None, 2) as client:
        found = {unit.name: d for unit, d in results(client, units, deadly, (str(tmp_path / "killed"),))}
    assert set(found) == {"a", "once", "b", "always", "c"}
    assert "KilledWorker" in found["always"]["error"]
    assert all("error" not in d for name, d in found.items() if name != "always")


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has its own way of keeping memory")
def test_workers_keep_freed_memory_and_no_notes_of_where_they_were() -> None:
    """A fit of 20 s took more than twice as long in a worker that asks the system for each array's memory anew; notes
    of 500 of them took 200 MB."""
    with cluster(None, 1) as client:
        ((_, document),) = results(client, [Unit("a", (), ())], page_faults, ())
        assert list(client.run(dask.config.get, "distributed.worker.profile.enabled").values()) == [False]
    assert document["faults"] < 0.1 * 100 * 8_000_000 / resource.getpagesize()


def test_no_scheduler_is_said(captures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["fleet", "fit", str(captures), "--out", str(tmp_path), "--dask", "nothing://x"]
    assert cli.main(words) == 2
    assert "no scheduler answers there" in capsys.readouterr().err
