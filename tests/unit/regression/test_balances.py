"""What a window says if the balances are only nearly right, against the closed forms of simple motions.

Information F over logarithms: a balance of size y may be off by the share SYSTEMATIC of it, so a parameter whose term,
as far as it is at right angles to the others', has the share s of the balance is known to SYSTEMATIC / s, however many
rows there are.
"""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.regression.balances import (
    ALIGNED,
    GramWindow,
    Sums,
    armature_slopes,
    column_noise,
    information,
    noise_gram,
    shaft_slopes,
)
from servo_daemon.regression.modulating import Windows, make_windows
from servo_daemon.regression.residual_analysis import mismatch_std
from servo_daemon.regression.rls_fit import SYSTEMATIC
from servo_daemon.samples import F64
from servo_daemon.tracking.validity.excitation import SYSTEMATIC_ENTER, SYSTEMATIC_LEAVE

#: The paper's motor.
VALUE = {"R": 0.4937, "L": 2.2769e-3, "K": 0.30628, "J": 0.009751, "B": 0.51141, "TL": 0.0, "i0": 0.0}
ARMATURE = ("R", "L", "K", "y")
SHAFT = ("J", "B", "y")
N = 1000
#: 1 kHz, windows of 0.1 s, half overlapping, over 5 s: as the shaft's regression has them.
PERIOD_S, LENGTH, SAMPLES = 1e-3, 101, 5001


def gram(*columns: F64) -> F64:
    rows = np.column_stack(columns)
    return np.asarray(rows.T @ rows)


def armature(current: F64, slope: F64, speed: F64) -> F64:
    """Gram matrix of a voltage balance that closes."""
    voltage = VALUE["R"] * current + VALUE["L"] * slope + VALUE["K"] * speed
    return gram(current, slope, speed, voltage)


def std(F: F64) -> F64:
    """Of each coordinate, all unknown together; a direction without information is left a huge one."""
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(F + 1e-6 * np.eye(len(F))))))


def armature_std(G: F64, *names: str) -> F64:
    noiseless = np.zeros_like(G)
    return std(information(G, noiseless, armature_slopes(ARMATURE, VALUE), names, 1.0))


def windows() -> tuple[F64, Windows]:
    time_s = np.arange(SAMPLES) * PERIOD_S
    return time_s, make_windows(time_s, np.arange(0, SAMPLES - LENGTH + 1, LENGTH // 2, dtype=np.intp), LENGTH)


# -- information --------------------------------------------------------------------------------------------------


def test_one_constant_speed_does_not_determine_R_and_K_together() -> None:
    """i and ω in proportion: either alone is known to SYSTEMATIC over its share, both together not at all."""
    current, speed = np.full(N, 5.0), np.full(N, 40.0)
    G = armature(current, np.zeros(N), speed)
    voltage = 5.0 * VALUE["R"] + 40.0 * VALUE["K"]
    assert armature_std(G, "R")[0] == pytest.approx(SYSTEMATIC * voltage / (5.0 * VALUE["R"]), rel=1e-6)
    assert armature_std(G, "K")[0] == pytest.approx(SYSTEMATIC * voltage / (40.0 * VALUE["K"]), rel=1e-6)
    assert (armature_std(G, "R", "K") > 100.0).all()


@pytest.mark.parametrize("rows", [N, 100 * N])
def test_a_small_transient_determines_them(rows: int) -> None:
    """2 % of the rows with half the current more at the same speed. What of i is at right angles to ω then has
    Σ i⊥² = δ² m (1 − m/n) with m of n rows δ higher; the length of the run does not matter."""
    m, delta = rows // 50, 2.5
    current, speed = np.full(rows, 5.0), np.full(rows, 40.0)
    current[:m] += delta
    G = armature(current, np.zeros(rows), speed)
    found = armature_std(G, "R", "K")
    across = delta * np.sqrt(m * (1 - m / rows))
    assert found[0] == pytest.approx(SYSTEMATIC * np.sqrt(G[-1, -1]) / (VALUE["R"] * across), rel=1e-3)
    assert (found < SYSTEMATIC_ENTER).all()


def test_at_constant_current_L_is_not_determined() -> None:
    current = np.full(N, 5.0)
    current[:20] += 2.5
    G = armature(current, np.zeros(N), np.full(N, 40.0))
    R, L, K = armature_std(G, "R", "L", "K")
    assert L > 100.0 and max(R, K) < SYSTEMATIC_ENTER


@pytest.mark.parametrize(("share", "determined"), [(1e-3, False), (1e-2, True)])
def test_a_term_must_be_more_than_a_thousandth_of_its_balance(share: float, determined: bool) -> None:
    """Friction at right angles to the inertia's torque, as on a sine, but only this share of it: B is known to
    SYSTEMATIC / share. SYSTEMATIC is a thousandth."""
    angle = 2 * np.pi * np.arange(N) / N
    inertia, friction = np.cos(angle), share * np.sin(angle)
    value = {**VALUE, "J": 2.0, "B": 3.0}
    G = gram(inertia / 2.0, friction / 3.0, inertia + friction)
    F = information(G, np.zeros_like(G), shaft_slopes(SHAFT, value, False), ("J", "B"), 1.0)
    J, B = std(F)
    assert pytest.approx(SYSTEMATIC, rel=1e-3) == J
    assert pytest.approx(SYSTEMATIC / share, rel=1e-3) == B
    assert B < SYSTEMATIC_ENTER if determined else B > SYSTEMATIC_LEAVE


def test_an_error_of_the_voltage_lies_less_along_the_current_s_derivative() -> None:
    """L alone: what it would be, times `ALIGNED`, which is far less than 1."""
    assert ALIGNED["L"] < 0.25
    angle = 2 * np.pi * np.arange(N) / N
    G = armature(5.0 * np.cos(angle), -500.0 * np.sin(angle), np.zeros(N))
    share = 500.0 * VALUE["L"] / np.hypot(5.0 * VALUE["R"], 500.0 * VALUE["L"])
    assert armature_std(G, "L")[0] == pytest.approx(ALIGNED["L"] * SYSTEMATIC / share, rel=1e-3)


def test_per_current_or_per_torque_is_the_same_information() -> None:
    """The shaft's balance divided by K says the same of J and B."""
    angle = 2 * np.pi * np.arange(N) / N
    acceleration, speed = 300.0 * np.cos(angle), 20.0 * np.sin(angle)
    torque = VALUE["J"] * acceleration + VALUE["B"] * speed
    zero = np.zeros((3, 3))
    by_torque = information(gram(acceleration, speed, torque), zero, shaft_slopes(SHAFT, VALUE, False), ("J", "B"), 1.0)
    G = gram(acceleration, speed, torque / VALUE["K"])
    by_current = information(G, zero, shaft_slopes(SHAFT, VALUE, True), ("J", "B"), VALUE["K"])
    np.testing.assert_allclose(by_current, by_torque, rtol=1e-9)


def test_J_B_and_K_have_a_common_factor_in_the_shaft_alone() -> None:
    """K i = J dω/dt + B ω: all three larger by the same share is no difference. The armature's balance settles it."""
    angle = 2 * np.pi * np.arange(N) / N
    acceleration, speed = 300.0 * np.cos(angle), 20.0 * np.sin(angle)
    G = gram(acceleration, speed, (VALUE["J"] * acceleration + VALUE["B"] * speed) / VALUE["K"])
    F = information(G, np.zeros((3, 3)), shaft_slopes(SHAFT, VALUE, True), ("J", "B", "K"), VALUE["K"])
    # Cancels to rounding: 1e-9 of the largest.
    assert np.abs(F @ np.ones(3)).max() < 1e-9 * np.abs(F).max()


def test_nothing_moves_nothing_known() -> None:
    F = information(np.zeros((4, 4)), np.zeros((4, 4)), armature_slopes(ARMATURE, VALUE), ("R", "L", "K"), 1.0)
    np.testing.assert_array_equal(F, np.zeros((3, 3)))


# -- noise in the regressors ----------------------------------------------------------------------------------------


def shaft_gram(w: Windows, current: F64, position: F64) -> F64:
    return gram(w.integral(position, 2), -w.integral(position, 1), w.integral(current))


def test_regressors_that_are_only_noise_do_not_count() -> None:
    """Standstill: current and encoder show nothing but noise, and J and B fit that as well as anything. With what the
    noise may add taken out, not a single direction is left; a real motion loses next to nothing by it."""
    rng = np.random.default_rng(1)
    time_s, w = windows()
    noise_std = {"current_A": 0.02, "position_rad": 1e-4}
    noise_var = {name: s**2 for name, s in noise_std.items()}
    current = noise_std["current_A"] * rng.normal(size=SAMPLES)
    position = noise_std["position_rad"] * rng.normal(size=SAMPLES)
    slopes, names = shaft_slopes(SHAFT, VALUE, True), ("J", "B", "K")
    noise = noise_gram(SHAFT, w.weight_squares, noise_var, "current_A")

    still = shaft_gram(w, current, position)
    believed = information(still, np.zeros((3, 3)), slopes, names, VALUE["K"])
    assert (std(believed)[:2] < SYSTEMATIC_ENTER).all(), "without the noise taken out J and B would count as shown"
    left = information(still, noise, slopes, names, VALUE["K"])
    assert np.linalg.eigvalsh(left).max() <= 0.0

    omega = 2 * np.pi * 2.0
    speed, acceleration = 5.0 * np.sin(omega * time_s), 5.0 * omega * np.cos(omega * time_s)
    current = current + (VALUE["J"] * acceleration + VALUE["B"] * speed) / VALUE["K"]
    moving = shaft_gram(w, current, position + 5.0 / omega * (1.0 - np.cos(omega * time_s)))
    of_J_and_B = std(information(moving, noise, slopes, ("J", "B"), VALUE["K"]))
    np.testing.assert_allclose(
        of_J_and_B, std(information(moving, 0 * noise, slopes, ("J", "B"), VALUE["K"])), rtol=0.1
    )
    assert (of_J_and_B < SYSTEMATIC_ENTER).all()


def test_noise_is_taken_out_of_its_own_column_only() -> None:
    """R: the current, not differentiated; L: once; K: the position once; y as it is told; a voltage has none."""
    squares = np.array([1.0, 10.0, 100.0])
    only_current = np.diag(noise_gram(ARMATURE, squares, {"current_A": 2.0}, None))
    assert only_current[0] > 0 and only_current[1] == pytest.approx(10.0 * only_current[0])
    assert only_current[2] == 0.0 and only_current[3] == 0.0
    only_position = np.diag(noise_gram(SHAFT, squares, {"position_rad": 3.0}, "current_A"))
    assert only_position[1] > 0 and only_position[0] == pytest.approx(10.0 * only_position[1])
    assert only_position[2] == 0.0
    assert np.diag(noise_gram(SHAFT, squares, {"current_A": 2.0}, "current_A"))[2] == only_current[0]
    assert (noise_gram(ARMATURE, squares, {}, None) == 0.0).all()
    # With a margin: never less than what white noise adds on average.
    noise = {"current_A": 2.0, "position_rad": 3.0}
    added = np.diag(noise_gram(ARMATURE, squares, noise, None))[:3]
    assert (added >= np.diag(column_noise(ARMATURE[:3], squares, noise))).all()


def test_column_noise_is_what_white_noise_adds_on_average() -> None:
    """100 runs of 99 windows that overlap by half: some 5000 independent squares, so the mean is within
    4 √(2/5000) = 8 %."""
    rng = np.random.default_rng(2)
    _, w = windows()
    sums = np.zeros(2)
    for _ in range(100):
        position = 1e-3 * rng.normal(size=SAMPLES)
        sums += np.square([w.integral(position, 2), w.integral(position, 1)]).sum(axis=1) / 100
    expected = np.diag(column_noise(SHAFT[:2], w.weight_squares, {"position_rad": 1e-6}))
    np.testing.assert_allclose(sums, expected, rtol=0.08)


# -- the window -----------------------------------------------------------------------------------------------------


def test_the_window_holds_the_last_seconds() -> None:
    window = GramWindow(5.0)
    assert window.total(0.0) is None
    rng = np.random.default_rng(3)
    parts = [(rng.normal(size=(7, 2)), rng.normal(size=7)) for _ in range(10)]
    for k, (Phi, y) in enumerate(parts):
        window.add(float(k), Sums.of(Phi, y, np.full(3, 1.0 + k)))
    total = window.total(9.0)
    assert total is not None
    rows = np.vstack([np.column_stack(p) for p in parts[4:]])  # 4 s .. 9 s: none is older than 5 s
    np.testing.assert_allclose(total.gram, rows.T @ rows, rtol=1e-12)
    np.testing.assert_allclose(total.weight_squares, np.full(3, sum(range(5, 11))))
    assert window.total(14.5) is None, "all of it is too old by now"
    window.add(15.0, Sums.of(*parts[0], np.ones(3)))
    window.clear()
    assert window.total(15.0) is None


# -- balances that do not close ---------------------------------------------------------------------------------------

#: A torque balance on a sine: amplitude of the speed, rad/s, and angular frequency, rad/s.
SPEED, OMEGA = 20.0, 15.0


def shaft_with_friction(Tc: float, noise: F64 | float = 0.0) -> F64:
    """Gram matrix over a whole number of periods; dry friction Tc that no column has; y in A."""
    phase = 2 * np.pi * (np.arange(N) + 0.5) / (N / 4)
    speed, acceleration = SPEED * np.sin(phase), SPEED * OMEGA * np.cos(phase)
    torque = VALUE["J"] * acceleration + VALUE["B"] * speed + Tc * np.sign(speed)
    return gram(acceleration, speed, torque / VALUE["K"] + noise)


def shaft_mismatch(G: F64, expected: float = 0.0) -> dict[str, float]:
    slopes = {name: slope / VALUE["K"] for name, slope in shaft_slopes(SHAFT, VALUE, True).items()}
    return mismatch_std(G, expected, slopes)


def test_a_balance_that_closes_leaves_nothing_open() -> None:
    found = shaft_mismatch(shaft_with_friction(0.0))
    assert {"J", "B"} <= found.keys()
    assert max(found.values()) < 1e-6


def test_noise_that_is_expected_leaves_nothing_open() -> None:
    """White noise of 10 % of the current: once its sum of squares is expected, only chance is left. Over N = 1000 rows
    that sum varies by √(2/N) = 4.5 %, at most three times as much; and the 1 % (rms) within which a balance closes
    anyway is 1 % of it: at most 0.135 − 0.01 of the noise's square stays. Were it not expected, all of it would."""
    rms = np.sqrt(shaft_with_friction(0.0)[-1, -1] / N)
    noise = 0.1 * rms * np.random.default_rng(4).normal(size=N)
    G = shaft_with_friction(0.0, noise)
    shares = {"J": VALUE["J"] * SPEED * OMEGA, "B": VALUE["B"] * SPEED}
    expected, surprised = shaft_mismatch(G, N * (0.1 * rms) ** 2), shaft_mismatch(G)
    for name, amplitude in shares.items():
        open_if_all = 0.1 * rms * VALUE["K"] / (amplitude / np.sqrt(2))
        assert expected[name] < np.sqrt(0.125) * open_if_all
        assert surprised[name] == pytest.approx(open_if_all, rel=0.1)


def test_a_dry_friction_that_is_not_in_the_model_opens_J_and_B() -> None:
    """sgn ω is 4/π of its fundamental and the rest: 1 − 8/π² of its square is left by the best fit (which has B too
    large). The 1 % (rms) of the balance within which it closes anyway is taken off; what remains, along each
    parameter's own term, is the spread. B's error stays within it."""
    Tc = 0.3 * VALUE["B"] * SPEED
    G = shaft_with_friction(Tc)
    structure = Tc**2 * (1 - 8 / np.pi**2) - 1e-4 * VALUE["K"] ** 2 * G[-1, -1] / N
    found = shaft_mismatch(G)
    terms = {"J": VALUE["J"] * SPEED * OMEGA / np.sqrt(2), "B": VALUE["B"] * SPEED / np.sqrt(2)}
    for name, rms in terms.items():
        assert found[name] == pytest.approx(np.sqrt(structure) / rms, rel=0.02)
        assert found[name] > 0.1
    wrong = 4 / np.pi * Tc / (VALUE["B"] * SPEED)
    assert wrong < 4 * found["B"]


def test_with_the_friction_in_the_model_it_closes_again() -> None:
    Tc = 0.3 * VALUE["B"] * SPEED
    phase = 2 * np.pi * (np.arange(N) + 0.5) / (N / 4)
    speed, acceleration = SPEED * np.sin(phase), SPEED * OMEGA * np.cos(phase)
    torque = VALUE["J"] * acceleration + VALUE["B"] * speed + Tc * np.sign(speed)
    slopes = shaft_slopes(("J", "B", "Tc", "y"), {**VALUE, "Tc": Tc}, False)
    found = mismatch_std(gram(acceleration, speed, np.sign(speed), torque), 0.0, slopes)
    assert {"J", "B", "Tc"} <= found.keys() and max(found.values()) < 1e-6
