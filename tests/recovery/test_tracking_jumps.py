"""Steps of a parameter are named, sized and followed; what is no step is not named. On the independent generator.

20 s runs at 1 kHz, the step or fault after 10 s, a datasheet wrong by 40 %, laboratory sensors. A case that does not
hold is marked with what was measured.
"""

from __future__ import annotations

import zlib
from functools import cache

import numpy as np
import pytest

from servo_daemon.samples import F64
from tests.recovery.generator import MOTORS, Scenario, generate, typical
from tests.recovery.tracking.cases import CASES, Case
from tests.recovery.tracking.follow import NAMES, Told, Track, nominal_of, tracked
from tests.recovery.tracking.scenarios import truth_of

pytestmark = pytest.mark.usefixtures("generator_built")

SECONDS, CHANGE_S, SEED = 20.0, 10.0, 1
#: The issue's: recognised within, followed after, s; and how near then.
RECOGNISED_S, FOLLOWED_S, NEAR = 2.0, 5.0, 0.03
#: Calibrated intervals are left by 4 std once in 16,000 independent values; a run has some dozens.
STDS = 4.0
STEPS = ("R +30 %", "J +30 %", "load step in the model")
HIDDEN_LOAD = "load step not in the model"
FAULTS = ("voltage reported 0 for 50 ms", "current frozen for 2 s")
#: Excitation of the cases: a multisine, and as named.
MOTIONS = ("", ", pick and place")


@cache
def followed(name: str, motor: str) -> tuple[Case, Track]:
    """A case's run; several tests look at it."""
    case = CASES[name](MOTORS[motor], SECONDS, SEED)
    return case, tracked(case.recording, nominal_of(MOTORS[motor]), case.model)


def jumps(track: Track) -> list[Told]:
    return [t for t in track.told if t.kind == "parameter_jump"]


def errors(case: Case, track: Track) -> F64:
    """Shape (m, parameters): as shares of the true values; of a load torque as shares of what it is at the end."""
    return np.asarray((track.value - truth_of(case, track)) / [abs(case.truth[name][-1]) for name in track.names])


def each(*names: str, fast: bool = False) -> pytest.MarkDecorator:
    """All motors under both motions; `fast`: of each name and motion one motor, of the next another; else as marked."""
    rows = []
    for turn, name in enumerate(n + motion for n in names for motion in MOTIONS):
        for k, motor in enumerate(MOTORS):
            marks = [pytest.mark.slow] if fast and k != turn % len(MOTORS) else []
            rows.append(pytest.param(name, motor, marks=marks, id=f"{name}-{motor}"))
    return pytest.mark.parametrize(("name", "motor"), rows)


# -- steps that a parameter explains ----------------------------------------------------------------------------------


@each(*STEPS, fast=True)
def test_a_step_is_named_within_two_seconds_and_nothing_else(name: str, motor: str) -> None:
    case, track = followed(name, motor)
    assert [t.data["parameter"] for t in jumps(track)] == [case.stepped], [t.message for t in jumps(track)]
    (told,) = jumps(track)
    assert CHANGE_S < told.time_s <= CHANGE_S + RECOGNISED_S
    # The event names when it began. What is unexplained is judged in ticks of 0.1 s, so no sooner than one before; a
    # dwell, in which nothing shows, may come first.
    began = told.data["time_s"]
    assert isinstance(began, float)
    assert CHANGE_S - 0.11 <= began <= CHANGE_S + (0.11 if "pick" not in name else 1.0)
    assert track.white[(track.time_s > CHANGE_S) & (track.time_s < CHANGE_S + 3.0)].all(), "what is explained is none"


@pytest.mark.first_is_fast
@each(*STEPS)
def test_the_size_of_a_step_is_right_to_three_percent(name: str, motor: str) -> None:
    case, track = followed(name, motor)
    told, values = jumps(track)[0].data, case.truth[case.stepped]
    assert isinstance(told["from"], float) and isinstance(told["to"], float)
    assert told["to"] - told["from"] == pytest.approx(values[-1] - values[0], rel=NEAR)


@pytest.mark.first_is_fast
@each(*STEPS)
def test_values_are_right_again_after_five_seconds(name: str, motor: str) -> None:
    """All but L, for which see the next test."""
    case, track = followed(name, motor)
    seen = [k for k, p in enumerate(track.names) if p != "L"]
    late = track.time_s >= CHANGE_S + FOLLOWED_S
    worst = np.abs(errors(case, track)[late]).max(axis=0)
    assert (worst[seen] < NEAR).all(), dict(zip(track.names, worst, strict=True))
    assert track.tracking[late][:, seen].all()


@each(*STEPS, fast=True)
def test_inductance_is_right_again_after_five_seconds(name: str, motor: str) -> None:
    """Or says how much it is off: in pick and place the posterior Cramér–Rao bound of the RE 40's L (L/R = 0.3 ms) is
    1.8 % after 20 s."""
    case, track = followed(name, motor)
    late, k = track.time_s >= CHANGE_S + FOLLOWED_S, track.names.index("L")
    spread = track.std[late, k] / case.truth["L"][-1]
    assert (np.abs(errors(case, track)[late, k]) < np.maximum(NEAR, 3.0 * spread)).all()
    assert spread.max() < 0.07  # with the sampling skew (δ·R) in it, 3 % of this L


@pytest.mark.slow
def test_a_hidden_brush_drop_makes_values_wander_and_names_no_step() -> None:
    """2 % of the voltage: little enough for white innovations, and K follows what the motor is doing by 3 %."""
    motor, rng = MOTORS["gear"], np.random.default_rng(zlib.crc32(b"false-steps/gear/prbs/brush_voltage_drop/0.02/2"))
    hidden = typical("brush_voltage_drop", motor, 0.02, seconds=300.0, rng=rng)
    nominal = {name: float(getattr(motor, name) * (1 + rng.uniform(-0.4, 0.4))) for name in NAMES}
    recording = generate(motor, Scenario("prbs", 300.0, effects=hidden, seed=2))
    assert jumps(tracked(recording, nominal | {"J_m": 0.6 * min(nominal["J"], motor.J)})) == []


# -- a step that no parameter explains --------------------------------------------------------------------------------


@pytest.mark.first_is_fast
@each(HIDDEN_LOAD)
def test_a_load_that_is_not_in_the_model_is_a_mismatch_and_bends_nothing(name: str, motor: str) -> None:
    case, track = followed(name, motor)
    late = track.time_s >= CHANGE_S - 1.0
    assert track.white[track.time_s < CHANGE_S].all()
    not_white = track.time_s[~track.white]
    assert len(not_white) and not_white[0] <= CHANGE_S + RECOGNISED_S
    assert not jumps(track)
    worst = np.abs(errors(case, track)[late]).max(axis=0)
    for parameter in ("R", "K", "J"):
        assert worst[track.names.index(parameter)] < NEAR, dict(zip(track.names, worst, strict=True))


# -- no step -------------------------------------------------------------------------------------------------------


@cache
def clean(motion: str, motor: str) -> Track:
    recording = generate(MOTORS[motor], Scenario(motion, seconds=60.0, seed=SEED))
    return tracked(recording, nominal_of(MOTORS[motor]))


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motion", ["multisine", "pick_and_place"])
@pytest.mark.parametrize("motor", list(MOTORS))
def test_a_clean_run_reports_no_jump(motor: str, motion: str) -> None:
    assert not jumps(clean(motion, motor))


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motion", ["multisine", "pick_and_place"])
@pytest.mark.parametrize("motor", list(MOTORS))
def test_a_clean_run_reports_no_mismatch(motor: str, motion: str) -> None:
    track = clean(motion, motor)
    assert not [t for t in track.told if t.kind == "model_mismatch"]
    assert track.white.all()


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motor", list(MOTORS))
@pytest.mark.parametrize("name", FAULTS)
def test_a_passing_fault_of_an_instrument_is_no_jump_and_teaches_nothing(name: str, motor: str) -> None:
    case, track = followed(name, motor)
    assert not jumps(track), [t.message for t in jumps(track)]
    stds = np.where(track.tracking, np.abs(track.value - truth_of(case, track)) / track.std, 0.0)
    worst = dict(zip(NAMES, stds.max(axis=0), strict=True))
    assert max(worst.values()) < STDS, worst
    # Of interest only if the values were claimed before, during and after it. L of re40 is not, in these moves.
    claimed = [k for k, p in enumerate(NAMES) if (p, motor) != ("L", "re40")]
    assert track.tracking[track.time_s > 5.0][:, claimed].mean() > 0.9


# -- on other draws, of other parameters -----------------------------------------------------------------------------


def stepping(parameter: str, size: float, motion: str, motor: str, seed: int) -> tuple[Case, Track]:
    """40 s, the step after 20 s, a datasheet wrong by 30 %."""
    seconds, of = 40.0, MOTORS[motor]
    values = getattr(of, parameter) * np.where(np.arange(round(1000 * seconds)) < 500 * seconds, 1.0, 1.0 + size)
    recording = generate(of, Scenario(motion, seconds=seconds, ageing={parameter: values}, seed=seed))
    case = Case(motion, recording, truth={name: recording.truth.parameters[name] for name in NAMES}, change_s=20.0)
    return case, tracked(recording, nominal_of(of, 1.3))


@pytest.mark.first_is_fast
@pytest.mark.parametrize(
    ("parameter", "size", "motion", "motor", "seed"),
    [
        ("R", 0.3, "pick_and_place", "paper", 3),  # was rejected, and published 2 to 23 % off at 168 σ
        ("R", 0.3, "pick_and_place", "paper", 123),  # R, L, K, J and B named in its place, 25 to 40 σ off
        ("R", 0.1, "steps", "large", 7),  # was not named at all
        ("R", -0.25, "prbs", "paper", 7),  # was not named, 33 % off
        ("K", -0.1, "pick_and_place", "paper", 7),  # B, R and J were named
        ("K", -0.1, "steps", "large", 8),  # L was
        ("J", -0.3, "pick_and_place", "re40", 7),  # B was, two seconds late
        ("J", 0.1, "steps", "large", 8),
    ],
)
def test_the_one_parameter_that_stepped_is_named_and_no_other_is_told(
    parameter: str, size: float, motion: str, motor: str, seed: int
) -> None:
    case, track = stepping(parameter, size, motion, motor, seed)
    (told,) = jumps(track)
    assert told.data["parameter"] == parameter
    assert 20.0 < told.time_s <= 20.0 + RECOGNISED_S
    counted = track.tracking & ((track.time_s < 19.99) | (track.time_s > 20.0 + FOLLOWED_S))[:, None]
    stds = np.where(counted, np.abs(track.value - truth_of(case, track)) / track.std, 0.0)
    worst = dict(zip(NAMES, stds.max(axis=0), strict=True))
    assert max(worst.values()) < STDS, worst
    # (At a single moment it is a matter of luck: of the paper's motor in pick and place K, J and B are told apart for
    # 60 to 65 % of the time, whatever stepped.)
    after = track.time_s > 20.0 + FOLLOWED_S
    assert track.tracking[after].all(axis=1).mean() > 0.5, "all is known again, most of the time"


@pytest.mark.slow
@pytest.mark.parametrize("motor", list(MOTORS))
def test_what_passes_by_is_no_step_of_any_parameter(motor: str) -> None:
    """Single wrong samples of the voltage: a parameter that is free to move explains what follows one better than none,
    and is no other one for it."""
    case = CASES["voltage spikes"](MOTORS[motor], 40.0, 7)
    track = tracked(case.recording, nominal_of(MOTORS[motor], 1.3))
    assert not jumps(track)
    stds = np.where(track.tracking, np.abs(track.value - truth_of(case, track)) / track.std, 0.0)
    assert stds.max() < STDS, dict(zip(NAMES, stds.max(axis=0), strict=True))


@pytest.mark.slow
def test_a_load_that_is_not_in_the_model_tells_the_others_nothing() -> None:
    """Over ten draws K's error after it has no direction: 1.5 standard deviations on average where the samples around
    the step were learned from."""
    z = []
    for seed in range(10):
        case = CASES["load step not in the model, pick and place"](MOTORS["paper"], 40.0, seed)
        track = tracked(case.recording, nominal_of(MOTORS["paper"], 1.3))
        at, K = int(np.searchsorted(track.time_s, 23.0)), track.names.index("K")
        z.append(float((track.value - truth_of(case, track))[at, K] / track.std[at, K]))
    assert abs(np.mean(z)) < 3.0 / np.sqrt(len(z)), z
