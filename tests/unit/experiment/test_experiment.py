"""Planning: known optimal designs, information against differences, motions within their limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from servo_daemon.errors import BadInputError
from servo_daemon.experiment import Limits, Request, Sensors, complete_limits, expected_stds, plan_motion
from servo_daemon.experiment.family import corners, fast_shapes, hold_shapes, servo_shapes, slow_shapes
from servo_daemon.experiment.loop import servo_voltage, suitable_gains
from servo_daemon.experiment.models import Model, make_model
from servo_daemon.experiment.questions import separation
from servo_daemon.experiment.search import choose
from servo_daemon.experiment.statistics import Noise, distance, fisher, make_noise, rows_of, start_state
from servo_daemon.identification.output_error.problem.rollout import free_run
from servo_daemon.simulate import PAPER_MOTOR

F64 = NDArray[np.float64]
RATE_HZ = 500.0
LIMITS = Limits(24.0, 20.0, 25.0, math.inf, 10.0)
NOISE = Noise(("current_A", "position_rad"), np.array([0.05, 1e-3]))


def model(*effects: str, draws: int = 1) -> Model:
    return make_model(effects, PAPER_MOTOR, (), LIMITS, 6.0, draws, 0)


def request(**more: object) -> Request:
    sensors = Sensors(4096, 0.05, 0.02)
    values = {"wanted": (), "between": (), "model": (), "limits": LIMITS, "seconds": 6.0, "rate_hz": RATE_HZ} | more
    return Request(PAPER_MOTOR, (), sensors=sensors, **values)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Line:
    """Readings y = f(x) at x = −1, 0, 1; `score` is D-optimality of a straight line, or T-optimality of a parabola
    against it: both have optimal designs that are known."""

    parabola: bool

    @property
    def truth(self) -> Model:
        raise NotImplementedError

    def statistics(self, rows: F64, cuts: object, draw: int) -> F64:
        raise NotImplementedError

    def members(self) -> list[list[F64]]:
        rows = [np.array([[1.0, x, x * x]] if self.parabola else [[1.0, x]]) for x in (-1.0, 0.0, 1.0)]
        return [[r.T @ r] for r in rows]

    def score(self, sums: Sequence[F64]) -> float:
        (S,) = sums
        if self.parabola:
            return float(np.log1p(distance(S, np.full(2, 1e-9))[0]))
        return float(np.linalg.slogdet(S + 1e-9 * np.eye(2))[1])


def test_a_line_is_best_measured_at_its_ends() -> None:
    """D-optimal for a straight line: half of the readings at either end."""
    line = Line(parabola=False)
    assert choose([line], [line.members()], 6) == [0, 0, 0, 2, 2, 2]


def test_a_parabola_is_best_told_from_a_line_in_the_middle() -> None:
    """T-optimal (Atkinson & Fedorov 1975): weights 1/4, 1/2, 1/4."""
    line = Line(parabola=True)
    assert choose([line], [line.members()], 8) == [0, 0, 1, 1, 1, 1, 2, 2]


def test_the_distance_is_what_least_squares_leaves() -> None:
    rng = np.random.default_rng(2)
    J, d = rng.normal(size=(50, 4)), rng.normal(size=50)
    A = np.column_stack([J, d])
    found, step = distance(A.T @ A, np.zeros(4))
    expected, left, *_ = np.linalg.lstsq(J, d, rcond=None)
    assert found == pytest.approx(float(left[0])) and step == pytest.approx(expected)


def test_information_is_that_of_the_simulation_itself() -> None:
    m = model("coulomb_friction")
    q, x0 = m.coordinates(m.draws[0]), start_state(m)
    rows = rows_of(12.0 * np.sin(2 * math.pi * 3.0 * np.arange(200) / RATE_HZ), RATE_HZ)
    columns = []
    for moved in [(np.eye(len(q))[k], 0.0) for k in range(len(q))] + [(0.0, np.eye(3)[k]) for k in range(3)]:
        ends = [free_run(m.plant, NOISE.channels, q + s * moved[0], x0 + s * moved[1], rows)[0] for s in (1e-6, -1e-6)]
        columns.append(((ends[0] - ends[1]) / 2e-6 / NOISE.std).ravel())
    J, states = np.array(columns[: len(q)]).T, np.array(columns[len(q) :]).T
    J = J - states @ np.linalg.lstsq(states, J, rcond=None)[0]
    assert fisher(m, q, x0, rows, NOISE) == pytest.approx(J.T @ J, rel=1e-3)


def test_noise_of_the_voltage_shows_where_the_motor_passes_it_on() -> None:
    m = model()
    quiet = make_noise(m, {"current_A": 0.01, "position_rad": 1e-4}, 0.0, RATE_HZ, 200)
    loud = make_noise(m, {"current_A": 0.01, "position_rad": 1e-4}, 0.5, RATE_HZ, 200)
    assert quiet.std == pytest.approx([0.01, 1e-4])
    assert (loud.std > 1.5 * quiet.std).all()


def test_a_model_that_contains_the_other_imitates_it() -> None:
    """Stribeck friction can be Coulomb's: nothing is left in that direction, and something in the other."""
    small, large = model("coulomb_friction"), model("stribeck_friction")
    rows = rows_of(6.0 * np.sin(2 * math.pi * 1.0 * np.arange(500) / RATE_HZ), RATE_HZ)
    left = []
    for truth, other in ((small, large), (large, small)):
        question = separation(truth, other, NOISE)
        for _ in range(8):
            question = question.stepped([question.statistics(rows, [(0, 500)], 0)])
        left.append(question.now(question.statistics(rows, [(0, 500)], 0)))
    assert left[0] < 0.02 * left[1] and left[1] > 100.0


@pytest.mark.parametrize("n", [100, 997])
def test_every_shape_keeps_to_its_size_and_comes_back(n: int) -> None:
    rng = np.random.default_rng(0)
    shapes = [*fast_shapes(n, RATE_HZ, corners(PAPER_MOTOR), rng), *slow_shapes(n)]
    shapes += [*servo_shapes(n, RATE_HZ, 4.0, rng), *hold_shapes(n)]
    for s in shapes:
        assert s.wave.shape == (n,) and np.isfinite(s.wave).all() and np.abs(s.wave).max() <= 1.0 + 1e-12, s.text
        if s.kind != "multisine":
            assert abs(s.wave[0]) < 1e-6 and abs(s.wave[-1]) < 0.25, s.text


def test_limits_that_are_missing_are_made_and_said() -> None:
    limits, notes = complete_limits(PAPER_MOTOR, voltage_V=24.0)
    assert limits.current_A == pytest.approx(0.2 * 24.0 / PAPER_MOTOR["R"])
    assert limits.velocity_rad_s == pytest.approx(
        24.0 * PAPER_MOTOR["K"] / (PAPER_MOTOR["R"] * PAPER_MOTOR["B"] + PAPER_MOTOR["K"] ** 2)
    )
    assert limits.travel_rad == math.inf and len(notes) == 4 and "current_A" in notes[0]
    limits, _ = complete_limits(PAPER_MOTOR, velocity_rad_s=10.0, current_A=5.0, travel_rad=2.0, current_rms_A=3.0)
    assert limits.voltage_V == pytest.approx(
        10.0 * 24.0 / complete_limits(PAPER_MOTOR, voltage_V=24.0)[0].velocity_rad_s
    )
    with pytest.raises(BadInputError, match="voltage_V"):
        complete_limits(PAPER_MOTOR)


def test_a_servo_follows_what_it_is_asked() -> None:
    m, gains = model("coulomb_friction"), suitable_gains(PAPER_MOTOR, RATE_HZ)
    values = np.array([m.draws[0][n] for n in m.plant.parameter_names])
    for kind, place, wanted in (("velocity", "velocity_rad_s", 5.0), ("position", "position_rad", 1.2)):
        reference = np.full(1500, wanted)
        v = servo_voltage(m.plant, values, start_state(m), gains, kind, reference, RATE_HZ)  # type: ignore[arg-type]
        states = free_run(m.plant, ("current_A",), m.coordinates(m.draws[0]), start_state(m), rows_of(v, RATE_HZ))[1]
        assert states[-1, m.plant.state_names.index(place)] == pytest.approx(wanted, rel=0.01)


@pytest.mark.parametrize("reference", ["voltage", "velocity", "position"])
def test_a_plan_stays_within_every_limit_for_every_motor_it_may_meet(reference: str) -> None:
    limits = Limits(24.0, 20.0, 15.0, 1.5, 10.0)
    plan = plan_motion(request(limits=limits, reference=reference, model=("coulomb_friction",)))
    assert plan.reference.shape == (3000,) and np.isfinite(plan.reference).all()
    worst = plan.worst
    assert worst.voltage_V <= 24.0 and worst.current_A <= 20.0 and worst.current_rms_A <= 10.0
    assert worst.velocity_rad_s <= 15.0 and worst.travel_rad <= 1.5
    assert worst.share(limits) > 0.5, "the room there is was not used"
    for p in expected_stds(plan):
        assert p.std <= 1.05 * p.default_std, p


def test_what_is_asked_for_is_what_gets_better() -> None:
    stds = {}
    for wanted in (("L",), ("B",)):
        stds[wanted] = {p.name: p.std for p in expected_stds(plan_motion(request(wanted=wanted)))}
    assert stds[("L",)]["L"] < stds[("B",)]["L"] and stds[("B",)]["B"] < stds[("L",)]["B"]


def test_the_same_seed_is_the_same_plan() -> None:
    first, second, other = (plan_motion(request(seed=s, seconds=2.0)).reference for s in (3, 3, 4))
    assert np.array_equal(first, second) and not np.array_equal(first, other)
