"""`servo-daemon train`: from a configuration to a model file, by way of a cluster too, and what is refused."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.learning.examples.drawing import TrainingSpec
from servo_daemon.learning.examples.training import simulate_training
from servo_daemon.learning.model.cache import cached_model, model_path, obtain_model, serves
from servo_daemon.learning.model.model import LearnedModel
from servo_daemon.learning.model.model_file import load_model
from servo_daemon.learning.training.fitting import train_model
from servo_daemon.learning.training.run import Job, train
from servo_daemon.simulate import PAPER_MOTOR
from tests.command_line import run_command

CONFIG = """
[[drive]]
name = "axis1"
driver = "serial"
model = ["coulomb_friction"]
nominal = { R = 1.1, L = 3.3e-4, K = 0.06, J = 4e-5, B = 3e-5, Tc = 0.01 }
limits = { voltage_V = 48.0 }
options = { port = "/dev/nowhere" }
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "servo.toml"
    path.write_text(CONFIG)
    return path


@pytest.mark.slow
def test_a_model_for_the_drive_of_a_config(config: Path, tmp_path: Path) -> None:
    out = tmp_path / "axis1.model"
    words = ("--motors", "160", "--rate", "500", "--window", "2", "--jobs", "1", "--out", out)
    document = run_command("train", "--config", config, *words, "--json").document
    model = load_model(out)
    assert model.spec.nominal["Tc"] == 0.01
    assert model.spec.effects == ("coulomb_friction",)
    assert model.spec.supply_V == 48.0
    assert document["motors_drawn"] == 160
    assert len(document["feature_names"]) == document["features_kept"] <= document["features"] / 2
    assert set(document["median_error"]) == {"R", "L", "K", "J", "B", "Tc"}
    assert document["accepted_foreign"] < document["accepted"]
    assert document["accepted_faulty"] < document["accepted"]


@pytest.mark.slow
def test_the_text_and_measured_captures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servo_daemon.learning.model.cache.cache_directory", lambda: tmp_path)
    capture = tmp_path / "known.csv"
    assert run_command("simulate", "--out", capture, "--seconds", "6", "--rate", "500").code == 0
    words = ("--motors", "160", "--rate", "500", "--window", "2", "--jobs", "1", "--measured", capture)
    result = run_command("train", *words)
    assert result.code == 0
    path = Path(result.out.splitlines()[0])
    assert path.parent == tmp_path / "models"
    assert "not seen" in result.out
    assert "of those with a drawn fault" in result.out
    model = load_model(path)
    assert model_path(model.spec) == path
    assert cached_model(model.spec, 160) is not None
    assert cached_model(model.spec, 161) is None
    path.write_bytes(b"damaged")
    assert cached_model(model.spec, 160) is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--motors", "0"), "--motors must be at least 1"),
        (("--learner", "magic"), "none of grnn"),
        (("--window", "1"), "2 to 10 s"),
        pytest.param(("--dask", "tcp://127.0.0.1:1"), "no scheduler answers there", marks=pytest.mark.slow),
        pytest.param(("--dask", "nonsense"), "(tcp://host:8786): missing port", marks=pytest.mark.slow),
        (("--measured", "/nowhere.csv"), "/nowhere.csv"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_wrong_use(words: tuple[str, ...], message: str) -> None:
    result = run_command("train", *words)
    assert result.code == 2
    assert message in result.err


def test_a_drive_without_a_datasheet(tmp_path: Path) -> None:
    path = tmp_path / "bare.toml"
    path.write_text('[[drive]]\nname = "axis1"\n[drive.nominal]\nR = 1.0\n')
    result = run_command("train", "--config", path)
    assert result.code == 2
    assert "nominal L, K, J, B missing" in result.err


def _process(*words: str) -> subprocess.Popen[bytes]:
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[3]), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_" + words[0], *words[1:]],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A real local cluster: a scheduler and two workers, each a process; its address and the workers."""
    pytest.importorskip("distributed")
    address_file = tmp_path / "scheduler.json"
    scheduler = _process(
        "scheduler", "--port", "0", "--no-dashboard", "--no-show", "--scheduler-file", str(address_file)
    )
    processes = [scheduler]
    try:
        deadline = time.monotonic() + 60
        while not address_file.exists() or not address_file.read_text().strip():
            assert scheduler.poll() is None, "the scheduler ended"
            assert time.monotonic() < deadline, "the scheduler does not start"
            time.sleep(0.05)
        words = ("--scheduler-file", str(address_file), "--nthreads", "1", "--no-nanny", "--no-dashboard")
        where = ("--local-directory", str(tmp_path), "--death-timeout", "60")
        processes += [_process("worker", *words, *where) for _ in range(2)]
        yield json.loads(address_file.read_text())["address"], processes[1:]
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.filterwarnings("ignore")  # Dask's own, about unclosed sockets of a worker that was killed
def test_a_cluster_that_loses_a_worker_gives_the_same_windows_and_the_same_model(
    cluster: tuple[str, list[subprocess.Popen[bytes]]],
) -> None:
    """Two worker processes; one is killed while they simulate. What comes out is what this machine alone makes."""
    address, workers = cluster
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
    spec = TrainingSpec(dict(PAPER_MOTOR), window_s=2.0, rate_hz=500.0)
    killed_at: list[int] = []

    def kill_one(done: int) -> None:
        if not killed_at:
            workers[0].send_signal(signal.SIGKILL)
            killed_at.append(done)

    from_cluster = simulate_training(spec, 200, novel=True, dask=address, progress=kill_one)
    assert workers[0].wait(timeout=10) == -signal.SIGKILL
    assert killed_at[0] < 200
    alone = simulate_training(spec, 200, novel=True, jobs=1)
    for name in ("motor", "kind", "features", "truth"):
        assert np.array_equal(getattr(from_cluster, name), getattr(alone, name), equal_nan=True), name
    ours, theirs = (train_model(spec, w).predict(alone.features) for w in (alone, from_cluster))
    assert np.array_equal(ours.value, theirs.value, equal_nan=True)
    assert ours.declined == theirs.declined


def test_which_models_serve_for_a_capture() -> None:
    own = TrainingSpec(dict(PAPER_MOTOR), supply_V=48.0, counts_per_rev=4096.0)
    assert serves(own, TrainingSpec(dict(PAPER_MOTOR), rate_hz=1010.0))
    for other in ({"rate_hz": 900.0}, {"window_s": 4.0}, {"effects": ("coulomb_friction",)}):
        assert not serves(own, TrainingSpec(dict(PAPER_MOTOR), **other))  # type: ignore[arg-type]
    assert not serves(own, TrainingSpec(PAPER_MOTOR | {"R": 1.0}))


@pytest.mark.slow
def test_a_model_that_was_trained_for_the_drive_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servo_daemon.learning.model.cache.cache_directory", lambda: tmp_path)
    spec = TrainingSpec(dict(PAPER_MOTOR), window_s=2.0, rate_hz=250.0)
    own = dataclasses.replace(spec, supply_V=24.0)
    made, trained = obtain_model(own, 160, lambda: train(own, Job(160, jobs=1)))
    assert trained

    def never() -> LearnedModel:
        raise AssertionError("a model is kept")

    again, trained = obtain_model(spec, 160, never, own)
    assert not trained
    assert again.spec == made.spec == own
