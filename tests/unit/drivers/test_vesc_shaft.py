"""The shaft's angle out of `pid_pos` and tachometer, with and without an encoder, over pauses of the host."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.vesc.shaft import Shaft, Source


def shown(theta: np.ndarray, pole_pairs: int, encoder: bool, inverted: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """`pid_pos` and tachometer of a shaft at these angles."""
    turn = theta * (1 if encoder else pole_pairs) * (-1.0 if inverted else 1.0)
    return np.degrees(turn % (2 * np.pi)), np.floor(theta * pole_pairs / (np.pi / 3))


def run(shaft: Shaft, degrees: np.ndarray, steps: np.ndarray, block: int = 10) -> np.ndarray:
    """The angle, NaN while it is not known."""
    parts = []
    for k in range(0, len(degrees), block):
        angle = shaft.angle(degrees[k : k + block], steps[k : k + block])
        parts.append(np.full(len(degrees[k : k + block]), np.nan) if angle is None else angle)
    return np.concatenate(parts)


TIME = np.arange(0.0, 4.0, 0.005)
MOTION = 8.0 * np.sin(1.7 * TIME) + 0.9 * np.sin(11.0 * TIME)


@pytest.mark.parametrize("pole_pairs", [2, 3, 7, 14, 21])
@pytest.mark.parametrize(("encoder", "inverted"), [(True, False), (True, True), (False, False)])
def test_what_pid_pos_is_is_found(pole_pairs: int, encoder: bool, inverted: bool) -> None:
    shaft = Shaft("auto", None if encoder else pole_pairs)
    angle = run(shaft, *shown(MOTION, pole_pairs, encoder, inverted))
    assert (shaft.source, shaft.inverted) == ("encoder" if encoder else "electrical", inverted)
    known = np.isfinite(angle)
    assert known.mean() > 0.9
    np.testing.assert_allclose(np.diff(angle[known]), np.diff(MOTION[known]), atol=1e-9)


def test_a_swing_between_two_steps_decides_nothing() -> None:
    shaft = Shaft("auto", 7)
    small = 0.2 * np.sin(9.0 * TIME)
    assert np.isnan(run(shaft, *shown(small, 7, True))).all()
    assert shaft.source == "auto" and shaft.remark is not None


@pytest.mark.parametrize(("encoder", "told"), [(True, None), (True, 7), (False, 7)])
def test_turns_in_a_pause_of_the_host_are_not_lost(encoder: bool, told: int | None) -> None:
    theta = np.concatenate([MOTION, MOTION[-1] + 21.3 + MOTION])  # 3.4 turns within a pause
    angle = run(Shaft("auto", told), *shown(theta, 7, encoder))
    known = np.isfinite(angle)
    np.testing.assert_allclose(np.diff(angle[known]), np.diff(theta[known]), atol=1e-9)


def test_the_tachometer_wraps() -> None:
    degrees, steps = shown(MOTION, 7, False)
    raw = (steps + 2**31 - 5 + 2**31) % 2**32 - 2**31
    angle = run(Shaft("electrical", 7), degrees, raw)
    np.testing.assert_allclose(np.diff(angle), np.diff(MOTION), atol=1e-9)


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("pole_pairs", [4, 7, 20])
def test_the_direction_is_found_whatever_pauses_the_host_makes(pole_pairs: int, inverted: bool) -> None:
    """Turning steadily, with more than half a turn between two polls now and then from the start."""
    for seed in range(20):
        random = np.random.default_rng(seed)
        time_s = np.cumsum(np.where(random.random(400) < 0.3, random.uniform(0.03, 0.06, 400), 0.005))
        shaft = Shaft("auto", None)
        angle = run(shaft, *shown(110.0 * time_s, pole_pairs, True, inverted))
        assert (shaft.source, shaft.inverted) == ("encoder", inverted), seed
        known = np.isfinite(angle)
        np.testing.assert_allclose(np.diff(angle[known]), 110.0 * np.diff(time_s[known]), atol=1e-9)


@pytest.mark.parametrize(
    ("source", "pole_pairs", "encoder", "words"),
    [
        ("electrical", 7, True, 'position is "encoder", not "electrical"'),
        ("encoder", None, False, 'position is "electrical", not "encoder"'),
        ("auto", 5, True, "7 pole pairs, not 5"),
        ("encoder", 14, True, "7 pole pairs, not 14"),
    ],
)
def test_what_was_told_and_cannot_be_is_said(source: Source, pole_pairs: int | None, encoder: bool, words: str) -> None:
    """K would be off by as much, and nothing else would show it."""
    shaft = Shaft(source, pole_pairs)
    angle = run(shaft, *shown(4.0 * MOTION, 7, encoder))
    assert np.isnan(angle[200:]).all()
    assert words in str(shaft.remark)
    shaft.restart()
    assert words not in str(shaft.remark)


@pytest.mark.parametrize("source", ["encoder", "electrical", "auto"])
def test_of_one_pole_pair_both_are_the_same(source: Source) -> None:
    shaft = Shaft(source, 1)
    angle = run(shaft, *shown(MOTION, 1, True))
    known = np.isfinite(angle)
    assert known.mean() > 0.8
    np.testing.assert_allclose(np.diff(angle[known]), np.diff(MOTION[known]), atol=1e-9)
