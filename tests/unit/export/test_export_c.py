"""The exported estimator, compiled for this machine, against the daemon's own filter."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from servo_daemon.export.c.step import build_step, doublings_for
from servo_daemon.plant.build import build_plant
from tests.unit.export.firmware import NAMES, TRUE, OnBoard, compiled, daemons_estimates, exported, recorded
from tests.unit.export.motor import VALUES, Exporting, document

#: Of the daemon's standard deviation (issue 32).
WITHIN_STD = 0.1
STARTING, ESTIMATING, TRACKING, DOUBTFUL, INVALID = range(5)


@pytest.fixture(scope="module")
def library(program: Callable[..., str], tmp_path_factory: pytest.TempPathFactory):  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("c")
    exported(folder)
    return compiled(folder, program("gcc", "cc"))


def test_every_tick_is_the_daemons(library) -> None:  # type: ignore[no-untyped-def]
    capture = recorded(10.0)
    assert capture.counts[0] < 2**31 < capture.counts.max()  # the counter wraps
    values, std = OnBoard(library, capture.counts[0]).run(capture)
    expected, relative = daemons_estimates(capture)
    assert np.all(np.abs(np.log(values / expected)) < WITHIN_STD * relative)
    np.testing.assert_allclose(std / values, relative, rtol=0.01)
    error = np.abs(np.log(values[-1] / [TRUE[n] for n in NAMES])) / relative[-1]
    assert np.all(error < 4.0), error


def test_with_dry_friction_too(program: Callable[..., str], tmp_path: Path) -> None:
    exported(tmp_path, "coulomb_friction")
    capture = recorded(2.0, Tc=0.012)
    board = OnBoard(compiled(tmp_path, program("gcc", "cc")), capture.counts[0], friction=True)
    values, std = board.run(capture)
    expected, relative = daemons_estimates(capture, ("coulomb_friction",))
    assert np.all(np.abs(np.log(values / expected)) < WITHIN_STD * relative)
    assert np.all(np.abs(values[-1] - [*(TRUE[n] for n in NAMES), 0.012]) < 4.0 * std[-1])


def test_what_its_model_lacks_makes_it_doubtful(library) -> None:  # type: ignore[no-untyped-def]
    capture = recorded(2.0, Tc=0.02)
    board = OnBoard(library, capture.counts[0])
    board.run(capture)
    assert board.status == DOUBTFUL


def test_it_starts_from_nothing_and_says_when_it_knows(library) -> None:  # type: ignore[no-untyped-def]
    capture = recorded(2.0)
    board, seen = OnBoard(library, capture.counts[0], unknown=True), []
    for v, i, counts in zip(capture.voltage, capture.current, capture.counts, strict=True):
        board.sample(v, i, counts)
        seen.append(board.status)
    assert list(dict.fromkeys(seen)) == [STARTING, ESTIMATING, TRACKING]
    values, std = map(np.array, board.estimates())
    assert np.all(np.abs(values - [TRUE[n] for n in NAMES]) < 4.0 * std)


def test_standing_still_it_claims_nothing(library) -> None:  # type: ignore[no-untyped-def]
    board = OnBoard(library, 0.0, unknown=True)
    for k in range(500):
        board.sample(0.0, 0.01 * (-1) ** k, 0.0)
    assert board.status == STARTING


def test_a_wrong_sign_is_doubtful_and_no_number_is_survived(library) -> None:  # type: ignore[no-untyped-def]
    capture = recorded(3.0)
    board = OnBoard(library, capture.counts[0])
    for v, i, counts in zip(capture.voltage, capture.current, capture.counts, strict=True):
        board.sample(v, -i, counts)
    assert board.status == DOUBTFUL
    board = OnBoard(library, capture.counts[0])
    statuses = []
    for k, (v, i, counts) in enumerate(zip(capture.voltage, capture.current, capture.counts, strict=True)):
        board.sample(v, math.nan if k == 1000 else i, counts)
        statuses.append(board.status)
    assert statuses[999] == TRACKING and statuses[1000] == INVALID and statuses[-1] == TRACKING


def test_what_is_not_valid_is_not_believed(library) -> None:  # type: ignore[no-untyped-def]
    capture = recorded(2.0)
    board = OnBoard(library, capture.counts[0])
    for k, (v, i, counts) in enumerate(zip(capture.voltage, capture.current, capture.counts, strict=True)):
        board.sample(v, 99.0 if k % 3 else i, counts, 2 if k % 3 else 3)
    values, std = map(np.array, board.estimates())
    assert board.status == TRACKING
    assert np.all(np.abs(values - [TRUE[n] for n in NAMES]) < 4.0 * std)


@pytest.mark.parametrize("h", [1e-4, 2e-3, 0.05])
def test_its_step_is_the_plants(h: float) -> None:
    effects = ("coulomb_friction", "constant_load_torque")
    values = {name: row[0] for name, row in VALUES.items()} | {"TL": 0.002}
    names = ("R", "K", "J", "B", "Tc", "TL")
    code = build_step(names, values["L"], doublings_for(values, h))
    plant, x = build_plant(effects), np.array([0.5, 3.0, 0.2])
    p = [values[name] for name in names]
    expected = plant.step(x, 1.5, [values[n] for n in plant.parameter_names], 0.0, h)
    got, _, _, by_parameter, _ = (np.array(r).ravel() for r in code.function(x, x, x, p, 1.5, h))
    np.testing.assert_allclose(got, np.array(expected).ravel(), rtol=1e-8)
    moved = [v * (1.0 + 1e-6 * (k == 1)) for k, v in enumerate(p)]
    slope = (np.array(code.function(x, x, x, moved, 1.5, h)[0]).ravel() - got) / 1e-6
    np.testing.assert_allclose(by_parameter.reshape(3, -1)[:, 1], slope, rtol=1e-4, atol=1e-8)


def test_a_motor_that_it_would_be_wrong_about_is_refused(export: Exporting) -> None:
    content = document("coulomb_friction", "cogging_torque", names=("Tc", "Tcog", "n_cog", "phi_cog"))
    code, told = export(content, "--to", "c")
    assert code == 2
    assert "cogging_torque" in told and "wrong" in told
    code, told = export(document(L={"value": None}), "--to", "c")
    assert code == 2
    assert "needs L" in told
