"""Any motor with any covariance: designs are stable, keep what they promise, and the worst case is never better."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servo_daemon.errors import TuningError
from servo_daemon.samples import F64
from servo_daemon.tuning.assess import margins_of, smaller_gain_margin_dB
from servo_daemon.tuning.design import FAMILIES
from servo_daemon.tuning.knowledge import NEEDED, Ask, CascadeGains, Known, LoopSetup, MotorKnowledge
from servo_daemon.tuning.search import DESIGN_LIMITS, Design, check_ask, find
from servo_daemon.tuning.worst import region_of

FAMILY = {f.key: f for f in FAMILIES}


def between(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(math.log(low), math.log(high)).map(math.exp)


@st.composite
def motors(draw: st.DrawFn) -> dict[str, float]:
    """From a coreless 1 W motor to a 1 kW one; electrical time constants 0.05–20 ms, mechanical ones 2 ms–2 s, friction
    from none to half of the back-EMF's damping."""
    R, K = draw(between(0.05, 50.0)), draw(between(2e-3, 2.0))
    L = R * draw(between(5e-5, 2e-2))
    J = draw(between(2e-3, 2.0)) * K**2 / R
    B = draw(between(1e-4, 1.0)) * 0.5 * K**2 / R
    return {"R": R, "L": L, "K": K, "J": J, "B": B}


@st.composite
def covariances(draw: st.DrawFn) -> F64:
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    directions, _ = np.linalg.qr(rng.normal(size=(5, 5)))
    return draw(between(1e-3, 0.1)) ** 2 * directions @ np.diag(rng.uniform(0.0, 1.0, 5) ** 3) @ directions.T


def known(motor: dict[str, float], covariance: F64 | None = None) -> MotorKnowledge:
    parameters = {name: Known(motor[name], "estimate") for name in NEEDED}
    return MotorKnowledge(parameters) if covariance is None else MotorKnowledge(parameters, NEEDED, covariance)


def designed(key: str, motor: MotorKnowledge, setup: LoopSetup, ask: Ask) -> Design | None:
    """None where it says that this loop cannot be closed."""
    try:
        return find(FAMILY[key], motor, setup, ask, region_of(motor))
    except TuningError as error:
        assert "no gains" in str(error)
        return None


@pytest.mark.slow
@given(motors(), covariances(), st.sampled_from(sorted(FAMILY)), between(300.0, 20_000.0), st.floats(0.0, 2.5))
@settings(derandomize=True, max_examples=20, deadline=None)
def test_designs_are_stable_and_keep_their_margins(
    motor: dict[str, float], covariance: F64, key: str, rate_hz: float, delay: float
) -> None:
    setup = LoopSetup(rate_hz, delay_samples=delay)
    design = designed(key, known(motor, covariance), setup, Ask())
    if design is None:
        return
    m, worst = design.margins, design.worst
    assert worst is not None and m.stable and worst.margins.stable
    assert m.phase_margin_deg is not None and m.sensitivity_peak is not None
    assert m.phase_margin_deg >= DESIGN_LIMITS.phase_margin_deg
    assert m.sensitivity_peak <= DESIGN_LIMITS.sensitivity_peak
    gain = smaller_gain_margin_dB(m)
    assert gain is None or gain >= DESIGN_LIMITS.gain_margin_dB
    w = worst.margins
    assert w.phase_margin_deg is not None and setup.limits.phase_margin_deg <= w.phase_margin_deg <= m.phase_margin_deg
    assert w.sensitivity_peak is not None and m.sensitivity_peak <= w.sensitivity_peak <= setup.limits.sensitivity_peak
    least = smaller_gain_margin_dB(w)
    assert gain is None or (least is not None and setup.limits.gain_margin_dB <= least <= gain)
    assert design.response.settling_s is not None


@pytest.mark.slow
@given(motors(), st.sampled_from(sorted(FAMILY)), st.floats(0.1, 0.95))
@settings(derandomize=True, max_examples=12, deadline=None)
def test_what_is_asked_is_what_comes(motor: dict[str, float], key: str, share: float) -> None:
    setup = LoopSetup(1000.0)
    fast = designed(key, known(motor), setup, Ask(bandwidth_hz=100.0))
    if fast is None:
        return
    reach = fast.response.bandwidth_hz
    assert reach is not None and reach <= 100.0
    design = designed(key, known(motor), setup, Ask(bandwidth_hz=share * reach))
    assert design is not None
    if design.capped:
        assert "its bandwidth jumps" in (design.reason or "")
        return
    if share * reach > 0.1:  # slower ones are below the slowest design
        assert design.response.bandwidth_hz == pytest.approx(share * reach, rel=1e-3)
    if design.response.settling_s is None or design.response.settling_s < 0.02:
        return
    again = designed(key, known(motor), setup, Ask(settling_s=design.response.settling_s))
    assert again is not None and again.response.settling_s is not None
    # Where the settling time jumps to and fro (a resonance), the search looks at designs 10 % apart.
    slack = 1.1 if again.capped else 1.0
    assert again.response.settling_s <= slack * design.response.settling_s + 2e-3


@given(motors(), st.sampled_from(["speed_pi", "position_pid"]))
@settings(derandomize=True, max_examples=20, deadline=None)
def test_faster_loops_have_larger_gains_and_smaller_margins(motor: dict[str, float], key: str) -> None:
    setup = LoopSetup(1000.0)
    fast = designed(key, known(motor), setup, Ask(bandwidth_hz=100.0))
    if fast is None or fast.response.bandwidth_hz is None:
        return
    rows = []
    for share in (0.2, 0.4, 0.8):
        design = designed(key, known(motor), setup, Ask(bandwidth_hz=share * fast.response.bandwidth_hz))
        assert design is not None and isinstance(design.gains, CascadeGains)
        rows.append(
            (design.gains.speed_kp_V_s_rad, design.gains.speed_ki_V_rad, design.margins.sensitivity_peak or 0.0)
        )
    for kind in zip(*rows, strict=True):
        assert list(kind) == sorted(kind)


@given(motors(), st.floats(1.0, 3.0))
@settings(derandomize=True, max_examples=12, deadline=None)
def test_a_louder_loop_has_so_much_less_gain_margin(motor: dict[str, float], louder: float) -> None:
    setup = LoopSetup(1000.0)
    design = designed("speed_pi", known(motor), setup, Ask())
    if design is None or not isinstance(design.gains, CascadeGains) or design.margins.gain_margin_dB is None:
        return
    g = design.gains
    gains = CascadeGains(louder * g.speed_kp_V_s_rad, louder * g.speed_ki_V_rad, filter_hz=g.filter_hz)
    m = margins_of(gains, known(motor).log_values, setup)
    more = 20 * math.log10(louder)
    if more < design.margins.gain_margin_dB - 0.1:
        assert m.gain_margin_dB == pytest.approx(design.margins.gain_margin_dB - more, abs=0.01)


@settings(derandomize=True)
@given(st.floats(-10.0, 1e4), between(10.0, 1e5))
def test_an_ask_is_possible_or_refused_with_what_would_be(bandwidth_hz: float, rate_hz: float) -> None:
    try:
        check_ask(Ask(bandwidth_hz=bandwidth_hz), rate_hz)
    except TuningError as error:
        limit = f"at most {rate_hz / 10:g} Hz" if bandwidth_hz > 1.0 else "ask for at least"
        assert bandwidth_hz <= 0 or limit in str(error)
    else:
        assert 0 < bandwidth_hz <= rate_hz / 10
