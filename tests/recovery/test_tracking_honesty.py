"""Never a wrong value with a small std while `tracking`: motion that says little, an offset, a wrong datasheet.

On the independent generator at 1 kHz with laboratory sensors; every nominal value is 40 % too large.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from servo_daemon.config import DriveConfig
from servo_daemon.pipeline.pipeline import Pipeline
from servo_daemon.samples import F64
from tests.recovery.generator import BELT_SERVO, MOTIONS, MOTORS, Motor, Plan, Recording, Scenario, generate
from tests.recovery.tracking import faults
from tests.recovery.tracking.ageing import ageing_recording
from tests.recovery.tracking.cases import always, coarse_voltage, quiet, reversals, slow_sampling
from tests.recovery.tracking.faults import Where
from tests.recovery.tracking.follow import (
    NAMES,
    Flags,
    Track,
    block_of,
    deviations,
    info_of,
    nominal_of,
    sampled,
    tracked,
)
from tests.recovery.tracking.scenarios import NOMINAL
from tests.recovery.tracking.starts import run_start

pytestmark = pytest.mark.usefixtures("generator_built")

#: Calibrated intervals are left by 4 std once in 16,000 independent values; a run has some dozens.
STDS = 4.0
SEED = 1


def run(recording: Recording, motor: str) -> Track:
    return tracked(recording, nominal_of(MOTORS[motor]))


def worst(track: Track, recording: Recording) -> dict[str, float]:
    """Largest |error| / std of each parameter while it is tracking; 0 if it never is."""
    stds, _ = deviations(track, recording.truth.parameters, recording.truth.time_s, track.names)
    return dict(zip(track.names, np.abs(stds).max(axis=0).tolist(), strict=True))


def after(track: Track, time_s: float) -> Flags:
    return np.asarray(track.time_s > time_s)


# -- slow sampling -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [12.0, 20.0])
def test_samples_ten_times_slower_than_the_winding(rate_hz: float) -> None:
    """A filter that began with a wrong R is sure of a wrong L there (five times the truth, at 2,000 σ)."""
    scenario = Scenario("multisine", seconds=150.0, rate_hz=rate_hz, seed=3)
    recording = generate(MOTORS["paper"], scenario)
    found = worst(tracked(recording, {}), recording)
    assert max(found.values()) < STDS, found


# -- a load that the model lacks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("motor", "dry", "seconds"), [("gear", 0.0, 14.0), ("re40", 0.05, 10.0)])
def test_a_hoist_under_the_linear_model(motor: str, dry: float, seconds: float) -> None:
    """At one speed no regression tells R, and the filter makes of the load what it likes (R up to 17 times as large, at
    37 σ): what was last said of it holds, and what the regression excludes is not published."""
    m = MOTORS[motor]
    torque_Nm = m.K * m.rated_current_A
    effects = {"constant_load_torque": {"TL": 0.3 * torque_Nm}}
    if dry:
        effects["coulomb_friction"] = {"Tc": dry * torque_Nm}
    recording = generate(m, Scenario("reversals", seconds=seconds, rate_hz=500.0, effects=effects, seed=5))
    track = tracked(recording, {})
    stds, shares = deviations(track, recording.truth.parameters, recording.truth.time_s, track.names)
    wrong = (np.abs(stds) > STDS) & (np.abs(shares) > 0.05)
    assert not wrong.any(), dict(zip(track.names, wrong.mean(axis=0).tolist(), strict=True))


# -- constant speed ---------------------------------------------------------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize(
    ("motor", "seed"),
    [pytest.param(motor, seed, id=f"{motor}-{seed}") for motor in reversed(MOTORS) for seed in (1, 2)],
)
def test_constant_speed_from_the_start(motor: str, seed: int) -> None:
    """Nothing but one speed, and the approach to it in the first moment. Whatever is tracking is right. (The first of
    these goes over its start by a jump just before it is to do so anyway, and doubts it meanwhile.)"""
    recording = quiet("speed", lively=False)(MOTORS[motor], 30.0, seed).recording
    found = worst(run(recording, motor), recording)
    assert max(found.values()) < STDS, found


def constant_voltage(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """Open loop: 15 s of a multisine, then the voltage of a third of the speed."""
    plan = MOTIONS["multisine"](motor, time_s, rng)
    return replace(plan, reference=np.where(time_s < 15.0, plan.reference, 0.3 * motor.supply_V))


def held_speed(motor: Motor, time_s: F64, rng: np.random.Generator) -> Plan:
    """A servo at 0.3 of the full speed; for 15 s with a multisine on top of the controller's voltage."""
    dither = np.where(time_s < 15.0, MOTIONS["multisine"](motor, time_s, rng).reference, 0.0)
    return Plan("speed", np.full(len(time_s), 0.3 * motor.speed_max_rad_s), added_V=dither)


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motion", [constant_voltage, held_speed], ids=["open loop", "servo"])
@pytest.mark.parametrize("motor", list(MOTORS))
def test_constant_speed_after_a_multisine(motor: str, motion: object) -> None:
    """All was known; then R and K show only together, J hardly at all. What is still called tracking is right, and J,
    of which constant speed says nothing, is not called so any more once the window (5 s) is past the change."""
    recording = generate(MOTORS[motor], Scenario(motion, seconds=30.0, seed=SEED))  # type: ignore[arg-type]
    track = run(recording, motor)
    found = worst(track, recording)
    assert max(found.values()) < STDS, found
    known = [NAMES.index(p) for p in ("R", "K", "J")]
    lively = (track.time_s > 8.0) & (track.time_s < 15.0)
    assert track.tracking[lively][:, known].all(), "before, they were known"
    assert not track.tracking[after(track, 25.0), NAMES.index("J")].any()


# -- standstill -------------------------------------------------------------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize("lively", [False, True], ids=["from the start", "after 20 s of a multisine"])
@pytest.mark.parametrize("motor", list(MOTORS))
def test_at_standstill_nothing_is_tracking_after_ten_seconds(motor: str, lively: bool) -> None:
    case = quiet("standstill", lively=lively)(MOTORS[motor], 15.0, SEED)
    track = run(case.recording, motor)
    begin = case.change_s or 0.0
    assert track.tracking[track.time_s < begin].any() == lively
    late = after(track, begin + 10.0)
    assert late.sum() > 40
    assert not track.tracking[late].any(), dict(zip(NAMES, track.tracking[late].mean(axis=0), strict=True))
    assert max(worst(track, case.recording).values()) < STDS


@pytest.mark.slow
@pytest.mark.parametrize("motor", ["paper", "gear", "large"])
def test_a_rest_is_no_evidence_against_the_model(motor: str) -> None:
    """What the drive's own noise does at rest is in no balance: nothing is told of a shaft that stands. (The RE 40 has
    nothing that holds it: its drive's noise turns it by counts at a time.)"""
    case = quiet("standstill")(MOTORS[motor], 40.0, SEED)
    track = run(case.recording, motor)
    assert track.white[after(track, 20.0)].all(), track.told


# -- sampling far slower than the winding -----------------------------------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motor", list(MOTORS))
def test_a_hundred_samples_a_second_are_as_right_as_a_thousand(motor: str) -> None:
    """L/R is a millisecond, a tenth of the period: integrals over samples see nothing of it, the filter does."""
    case = slow_sampling(MOTORS[motor], 30.0, SEED)
    track = run(case.recording, motor)
    found = worst(track, case.recording)
    assert max(found.values()) < STDS, found
    late = after(track, 20.0)
    for parameter in ("R", "K", "J"):
        assert track.tracking[late, NAMES.index(parameter)].mean() > 0.9
    # What happens between two samples nothing but the filter's model sees: where that is in doubt, L is not claimed.
    assert track.tracking[-1, NAMES.index("L")] or not track.white[-1]


# -- a start in motion, under friction ---------------------------------------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motor", list(MOTORS))
def test_a_filter_that_starts_while_the_shaft_turns_under_dry_friction(motor: str) -> None:
    """With friction in the model a shaft may stick, and one that sticks has no speed to be wrong about: a filter that
    starts in motion must not begin there and stay there."""
    case = quiet("hold", friction="modelled")(MOTORS[motor], 1.0, 23)
    track = tracked(case.recording, nominal_of(MOTORS[motor]), case.model)
    error = np.abs(track.value - [case.truth[name][0] for name in track.names])
    assert np.max(np.where(track.tracking, error / track.std, 0.0)) < STDS
    known = [track.names.index(name) for name in ("R", "K", "J", "Tc")]
    assert track.tracking[(track.time_s > 12.0) & (track.time_s < 20.0)][:, known].all()


# -- an offset of the current sensor ----------------------------------------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motion", ["multisine", "pick_and_place"])
@pytest.mark.parametrize("motor", list(MOTORS))
def test_five_percent_of_current_offset_bends_nothing(motor: str, motion: str) -> None:
    """5 % of the rated current, which the user's model does not hold: R, K and J are tracking, and right."""
    clean = generate(MOTORS[motor], Scenario(motion, seconds=20.0, seed=SEED))
    recording = faults.current_offset(0.05)(clean, Where(MOTORS[motor], 0, SEED))
    track = run(recording, motor)
    found = worst(track, recording)
    for parameter in ("R", "K", "J"):
        assert found[parameter] < STDS, found
        assert track.tracking[after(track, 10.0), NAMES.index(parameter)].all()


# -- a wrong datasheet and a motion that says little at first ---------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize(
    ("motor", "motion", "seed"),
    [
        *((motor, motion, 1) for motor in MOTORS for motion in ("pick_and_place", "reversals")),
        ("paper", "pick_and_place", 2),
        ("paper", "reversals", 2),
        ("re40", "pick_and_place", 4),
        ("large", "pick_and_place", 9),
    ],
)
def test_a_start_is_honest(motor: str, motion: str, seed: int) -> None:
    """Dwells and slow triangles: what is known of the motor in the first seconds is little. (Of the paper's on slow
    reversals nothing that is tracking: R, K and B are identifiable there only by what is below a thousandth of the
    balance.)"""
    recording = generate(MOTORS[motor], Scenario(motion, seconds=20.0, seed=seed))
    track = run(recording, motor)
    assert track.tracking.any() or (motor, motion) == ("paper", "reversals")
    found = worst(track, recording)
    assert max(found.values()) < STDS, found


@pytest.mark.first_is_fast
@pytest.mark.parametrize("number", [42, 52, 62, 322, 332, 372])
def test_what_the_first_samples_did_not_show_is_not_claimed_on_the_way(number: int) -> None:
    """Starts of the benchmark with slow triangles: the filter met an inertia first where the acceleration changed, 1 s
    after its first samples had been gone over, and claimed J 6 to 25 % off at up to 25 σ until the second time."""
    start = run_start((number, 20.0))
    assert start.motion == "reversals"
    assert not start.claimed, start
    assert not start.on_the_way, start


@pytest.mark.first_is_fast
@pytest.mark.parametrize("number", [327, 547, 667])
def test_an_inductance_between_two_samples_is_not_learned_from_the_colour_of_the_noise(number: int) -> None:
    """L/R = 0.3 ms at 1 kHz: along its own states, with noise of the voltage taken for the sensor's, the filter was
    sure of an L 27 to 40 % too large (4.6 to 10 σ)."""
    start = run_start((number, 20.0))
    assert (start.motor, start.motion) == ("re40", "reversals")
    assert not start.claimed, start
    assert not start.on_the_way, start


@pytest.mark.parametrize("number", [87, 187])
def test_a_start_that_the_filter_does_not_find_is_found_by_likelihood(number: int) -> None:
    """A winding that settles between two samples, in slow reversals: the filter held half of the true L, the regression
    had R to 8 %, and R was never known."""
    start = run_start((number, 20.0))
    assert (start.motor, start.motion) == ("re40", "reversals")
    assert not start.failure, start
    assert not start.on_the_way, start


@pytest.mark.slow
def test_the_likeliest_constants_of_a_motor_that_ages_are_not_taken() -> None:
    """They predict worse than the filter that follows it (K, J, B and L 5 % off at 9 σ for half a minute)."""
    recording = ageing_recording(MOTORS["paper"], "pick_and_place", 30.0, 11)
    track = run(recording, "paper")
    found = worst(track, recording)
    assert max(found.values()) < STDS, found
    assert track.tracking[after(track, 10.0)].all()


@pytest.mark.slow
def test_what_has_jumped_and_cannot_be_relinearised_is_widened() -> None:
    """Slow reversals under friction: J went from −55 to −15 % with a σ of 3 %, along derivatives taken far off."""
    case = reversals(MOTORS["paper"], 60.0, 123)
    track = tracked(case.recording, nominal_of(MOTORS["paper"], NOMINAL), case.model)
    stds, _ = deviations(track, case.truth, case.recording.truth.time_s, track.names)
    assert np.abs(stds).max() < STDS, dict(zip(track.names, np.abs(stds).max(axis=0), strict=True))
    assert track.tracking[after(track, 12.0)].mean() > 0.8


@pytest.mark.slow
def test_the_greatest_likelihood_is_right_where_derivatives_lead_astray() -> None:
    """Slow reversals of the paper's motor: along the line of R and K the filter was 4 % off with K (rms of 12 draws, at
    1.6 of its standard deviations). What is likeliest is as far off as it says, and says 2 %."""
    motor, deviations_ = MOTORS["paper"], []
    for seed in (2, 22, 42, 82):
        recording = generate(motor, Scenario("reversals", seconds=20.0, seed=seed))
        pipeline = Pipeline(DriveConfig(nominal=nominal_of(motor)), info_of(recording))
        pipeline.process(block_of(recording))
        last = pipeline.finish()
        assert last is not None
        for name in ("R", "K", "J", "B"):
            value, std = last.estimators["ekf"].parameters[name]
            assert value is not None and std is not None
            truth = getattr(motor, name)
            assert std < 0.025 * truth
            deviations_.append((value - truth) / std)
    assert np.abs(deviations_).max() < 3.0, deviations_
    assert np.sqrt(np.mean(np.square(deviations_))) < 1.5, deviations_


@pytest.mark.parametrize("number", [156, 317, 478, 737, 839])
def test_noise_that_was_taken_for_another_is_not_information(number: int) -> None:
    """Starts of the large motor whose voltage noise was thought a third of what it is: R, L, J or B 5 to 18 % off at 5
    to 8 σ within the first seconds."""
    start = run_start((number, 20.0))
    assert start.motor == "large"
    assert not start.claimed, start
    assert not start.on_the_way, start


# -- a dry friction that is not in the model --------------------------------------------------------------------------


@cache
def with_friction(motor: str, motion: str) -> tuple[Track, Recording]:
    """8 % of the rated torque, stick-slip; two tests look at it."""
    effects = {"coulomb_friction": {"Tc": 0.08 * MOTORS[motor].working_torque_Nm}}
    recording = generate(MOTORS[motor], Scenario(motion, seconds=20.0, effects=effects, seed=SEED))
    return run(recording, motor), recording


@pytest.mark.first_is_fast
@pytest.mark.parametrize(
    ("motor", "motion"),
    [(motor, motion) for motor in MOTORS for motion in ("pick_and_place", "multisine")],
)
def test_the_shaft_is_not_claimed_where_its_balance_does_not_close(motor: str, motion: str) -> None:
    """J or B is 9 to 160 std off here by the filter alone; what the balance leaves open keeps them from tracking."""
    track, recording = with_friction(motor, motion)
    found = worst(track, recording)
    assert max(found["J"], found["B"]) < STDS, found
    assert not track.white.all()


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motion", ["pick_and_place", "multisine"])
@pytest.mark.parametrize("motor", list(MOTORS))
def test_the_winding_is_right_where_the_shaft_s_balance_does_not_close(motor: str, motion: str) -> None:
    """The torque that the shaft's balance leaves is in the filter's noise from the start: R and K are claimed, and
    right to 2 % (both were up to 20 % off)."""
    track, recording = with_friction(motor, motion)
    found = worst(track, recording)
    assert max(found["R"], found["K"]) < STDS, found
    late = after(track, 10.0)
    for parameter in ("R", "K"):
        k = NAMES.index(parameter)
        assert track.tracking[late, k].mean() > 0.9
        assert np.abs(track.value[late, k] / getattr(MOTORS[motor], parameter) - 1).max() < 0.02


def test_an_inductance_that_slow_reversals_hardly_show_is_not_claimed_beside_a_hidden_friction() -> None:
    """It was 71 % off at 35 std, on the filter's word alone."""
    motor, seed = BELT_SERVO, 3
    hidden = {"coulomb_friction": {"Tc": 0.1 * motor.working_torque_Nm}}
    recording = generate(motor, Scenario("reversals", seconds=20.0, effects=hidden, seed=seed))
    assert worst(tracked(recording, nominal_of(motor)), recording)["L"] < STDS


# -- instruments ------------------------------------------------------------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motor", list(MOTORS))
def test_a_voltage_in_steps_of_a_tenth_of_a_volt_leaves_L_open(motor: str) -> None:
    """What is rounding in the changes of the voltage is no response of the winding: L of the RE 40 came out twice as
    large, with 2 % of spread."""
    recording = coarse_voltage(MOTORS[motor], 40.0, SEED).recording
    track = run(recording, motor)
    found = worst(track, recording)
    assert max(found.values()) < STDS, found
    for parameter in ("R", "K", "J"):
        assert track.tracking[after(track, 10.0), NAMES.index(parameter)].all()


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motor", list(MOTORS))
def test_spikes_of_the_voltage_bend_nothing(motor: str) -> None:
    """Single samples at the supply's limit, every 2 s on average."""
    clean = generate(MOTORS[motor], Scenario("pick_and_place", seconds=40.0, seed=SEED))
    recording = faults.spikes("voltage_V")(clean, Where(MOTORS[motor], 0, SEED))
    track = run(recording, motor)
    found = worst(track, recording)
    assert max(found.values()) < STDS, found
    for parameter in ("R", "K", "J"):
        assert track.tracking[after(track, 10.0), NAMES.index(parameter)].all()


@pytest.mark.parametrize("motor", ["paper", "large"])
def test_nor_do_spikes_that_follow_each_other_just_after_the_start(motor: str) -> None:
    """Half a second after it, before any noise is known well: R of the large motor was 36 % off at 21 σ."""
    clean = generate(MOTORS[motor], Scenario("pick_and_place", seconds=20.0, seed=3))
    recording = faults.spikes("voltage_V")(clean, Where(MOTORS[motor], 0, 3))
    track = run(recording, motor)
    found = worst(track, recording)
    assert max(found.values()) < STDS, found
    assert track.tracking[after(track, 10.0)].all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 7, 123])
def test_spikes_of_the_current_bend_no_inductance(seed: int) -> None:
    """A minute of pick and place. Half believed, as before a spike was doubted, they put L of the large
    motor beyond 4 σ for an eighth of the time; told to the regressions before the start, as with the last of these
    seeds, J off by 8.5 σ for half a minute."""
    clean = generate(MOTORS["large"], Scenario("pick_and_place", seconds=60.0, seed=seed))
    recording = faults.spikes("current_A")(clean, Where(MOTORS["large"], 0, seed))
    track = run(recording, "large")
    found = worst(track, recording)
    assert max(found.values()) < STDS, found
    for parameter in ("R", "L", "K", "J"):
        assert track.tracking[after(track, 10.0), NAMES.index(parameter)].mean() > 0.8


# -- missing samples --------------------------------------------------------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize("run_length", [pytest.param(1, id="singly"), pytest.param(50, id="in runs")])
@pytest.mark.parametrize("motor", list(MOTORS))
def test_a_fifth_of_the_samples_missing_bends_nothing(motor: str, run_length: int) -> None:
    """What the voltage did in a short gap is on a straight line; after a long one the speed is found first."""
    clean = generate(MOTORS[motor], Scenario("pick_and_place", seconds=30.0, seed=SEED))
    recording = faults.missing(0.2, run_length)(clean, Where(MOTORS[motor], 0, SEED))
    track = run(recording, motor)
    found = worst(track, recording)
    assert max(found.values()) < STDS, found
    for parameter in ("R", "K", "J", "B"):
        assert track.tracking[after(track, 15.0), NAMES.index(parameter)].all()


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(2, id="start far off: R 19 % at 31 σ where nothing was gone over again"),
        pytest.param(9, id="gap in the first tick: taken for none it spoilt the regression for half a minute"),
    ],
)
def test_a_start_among_gaps_is_as_good_as_any(seed: int) -> None:
    case = always(faults.missing(0.2, 50))(MOTORS["paper"], 25.0, seed)
    track = run(case.recording, "paper")
    found = worst(track, case.recording)
    assert max(found.values()) < STDS, found
    for parameter in ("R", "K", "J"):
        assert track.tracking[after(track, 15.0), NAMES.index(parameter)].all()


# -- what was known and is so no longer -------------------------------------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motor", ["paper", "gear", "large"])
def test_what_was_known_is_held_and_not_the_datasheet(motor: str) -> None:
    """From 12 s on six of ten samples are missing, by twos, and for a time the balances close no more. What was known
    stays what it was, with a standard deviation that says how much that is still worth; the datasheet is 40 % wrong."""
    recording = generate(MOTORS[motor], Scenario("pick_and_place", seconds=24.0, seed=SEED))
    track = run(faults.missing(0.6, 2)(recording, Where(MOTORS[motor], 12000, SEED)), motor)
    known = np.maximum.accumulate(track.tracking, axis=0)
    assert known[-1].all()
    assert (known & ~track.tracking).any(), "nothing was lost: this says nothing"
    assert not (known & (track.status == "estimating")).any()
    truth = sampled(recording.truth.parameters, recording.truth.time_s, track.names, track.time_s)
    error = np.where(known, np.abs(track.value - truth), 0.0)
    assert (error < 0.05 * truth).all()
    assert (error < STDS * np.where(known, track.std, np.inf))[~track.tracking].all()


# -- a voltage that the model lacks -----------------------------------------------------------------------------------


@pytest.mark.first_is_fast
@pytest.mark.parametrize("motion", ["multisine", "pick_and_place"])
def test_a_brush_drop_that_the_model_lacks_is_not_passed_on_to_the_shaft(motion: str) -> None:
    """It biases R, L and K, which the armature's balance tells; J and B are seen beside K i only, and are biased
    along."""
    motor = MOTORS["paper"]
    drop = {"brush_voltage_drop": {"Vb": 0.02 * motor.supply_V}}
    recording = generate(motor, Scenario(motion, seconds=40.0, seed=3, effects=drop))
    found = worst(run(recording, "paper"), recording)
    assert max(found.values()) < STDS, found
