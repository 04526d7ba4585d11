"""Method 1: the paper's own numbers to the last printed digit, the algebra, and captures that lack something."""

from __future__ import annotations

import numpy as np
import pytest

from servo_daemon.errors import BadInputError
from servo_daemon.identification.paper.coefficients import compare_coefficients, quadratic_roots, redo_paper
from servo_daemon.parameters import LINEAR
from servo_daemon.samples import SampleBlock, make_block

PAPER = {p.name: p.nominal for p in LINEAR}


def test_the_papers_numbers() -> None:
    redone = redo_paper()
    assert [(n.name, n.rounded) for n in redone.comparison] == [
        ("J", "12.27e-3"), ("L", "1.81e-3"), ("D", "0.67"), ("R", "1.5"), ("K", "4.25e-3")
    ]  # fmt: skip
    assert all(n.agreeing == n.digits and n.rounded == n.printed for n in redone.comparison)
    assert [n.name for n in redone.comparison if n.is_input] == ["R", "K"]
    assert (redone.values["J"], redone.values["L"]) == (redone.root.J, redone.root.L)
    assert pytest.approx(1.815e-3, rel=1e-3) == redone.root.L
    # the other root exchanges R J and D L
    D, R = redone.values["D"], redone.values["R"]
    assert pytest.approx(D * redone.root.L) == R * redone.other_root.J
    assert pytest.approx(R * redone.root.J) == D * redone.other_root.L


def test_digits_that_do_not_agree_are_counted() -> None:
    redone = redo_paper(tau_2_s=18.5e-3)
    J = next(n for n in redone.comparison if n.name == "J")
    assert J.rounded == "12.33e-3" and (J.agreeing, J.digits) == (2, 4)
    large = next(n for n in redo_paper(tau_2_s=0.2).comparison if n.name == "J")
    assert large.agreeing == 0  # another number of digits before the point


def test_the_corrected_comparison_inverts_the_motor() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        R, L, K, J, B = 10 ** rng.uniform([-1, -4, -2, -5, -6], [1, -2, 0, -2, -2])
        N = R * B + K**2
        root, other = quadratic_roots((R * J + B * L) / N, J * L / N, R, B, N)
        found = root if R * J > B * L else other
        assert (pytest.approx(J, rel=1e-6), pytest.approx(L, rel=1e-6)) == (found.J, found.L)
        assert R / root.L >= B / root.J


def test_impossible_time_constants_are_refused() -> None:
    with pytest.raises(BadInputError, match="assumed R is wrong"):
        quadratic_roots(0.01, 1e-3, 1.0, 1.0, 1.0)


def block(**change: object) -> SampleBlock:
    """Two seconds of the paper's motor's channels, made by hand: turning steadily at 6 V."""
    n = 2000
    N = PAPER["R"] * PAPER["B"] + PAPER["K"] ** 2
    speed, current = 6 * PAPER["K"] / N, 6 * PAPER["B"] / N
    t = np.arange(n) * 1e-3
    channels = {
        "voltage_V": np.full(n, 6.0), "current_A": np.full(n, current), "position_rad": speed * t
    } | change  # fmt: skip
    return make_block(t, **channels)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"current_A": None}, "needs current_A"),
        ({"voltage_V": None}, "needs voltage_V"),
        ({"position_rad": None}, "needs a position or a speed"),
        ({}, "the voltage never changes"),
    ],
    ids=["no current", "no voltage", "no motion", "no step"],
)
def test_what_a_capture_lacks_is_said(change: dict[str, object], said: str) -> None:
    with pytest.raises(BadInputError, match=said):
        compare_coefficients([block(**change)], 0.5)


@pytest.mark.parametrize("R", [0.0, -1.0, float("nan")])
def test_a_useless_R_is_refused(R: float) -> None:
    with pytest.raises(BadInputError, match="assumed R greater than zero"):
        compare_coefficients([block()], R)


def test_a_motor_that_stands_is_refused() -> None:
    v = np.sign(np.sin(np.arange(2000) * 0.02))
    with pytest.raises(BadInputError, match=r"gain|does not turn|time constants"):
        compare_coefficients([block(voltage_V=v, current_A=v / 0.5, position_rad=np.zeros(2000))], 0.5)
