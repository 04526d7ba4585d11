"""The code of a step computes of its case distinctions what applies, and the same numbers."""

from __future__ import annotations

import casadi as ca
import numpy as np

from servo_daemon.plant.c_code.branches import with_branches
from servo_daemon.plant.compiled import SampleLoop


def a_step() -> ca.Function:
    """A distinction within another; what both sides need is e^x, and √ is needed whatever applies."""
    x, c, s = ca.SX.sym("x"), ca.SX.sym("c"), ca.SX.sym("s")
    shared, always = ca.exp(x), ca.sqrt(ca.fabs(x) + 1.0)
    inner = ca.if_else(s > 1.0, ca.sin(shared), ca.tanh(shared) * always)
    outer = ca.if_else(x > 0.0, inner / 3.0, ca.log(ca.fabs(x) + 2.0) - c)
    derivative = ca.jtimes(outer, x, 1.0)  # forward: a reverse one multiplies by nought
    return ca.Function("step", [x, c, s], [ca.fmod(x + outer + s, 2.0) - 1.0, ca.vertcat(outer, derivative, always)])


def generated(function: ca.Function) -> str:
    generator = ca.CodeGenerator("step.c", {"with_header": False})
    generator.add(function)
    return str(generator.dump())


def depths(code: str) -> dict[str, int]:
    """Function of the library: in how many blocks of the step it is called."""
    depth, found = 0, {}
    for line in code[code.index("static int casadi_f0") :].splitlines():
        if line.startswith("if (v"):
            depth = 1 + line.count("&&")
        elif line == "}":
            depth = 0
        for name in ("exp", "sin", "log", "tanh", "sqrt"):
            if f"={name}(" in line:
                found[name] = depth
    return found


def test_what_one_case_needs_stands_behind_its_condition() -> None:
    assert depths(with_branches(generated(a_step()))) == {"exp": 1, "sqrt": 0, "sin": 2, "tanh": 2, "log": 1}


def test_the_numbers_are_the_same_in_every_case() -> None:
    step, rng = a_step(), np.random.default_rng(3)
    samples = rng.uniform(-1.0, 3.0, (2000, 1))
    found = [SampleLoop(step, compiled=c).run(np.array([0.3]), np.array([0.7]), samples) for c in (True, False)]
    assert len(np.unique(np.sign(found[1][:, 0]))) > 1
    assert found[0].tobytes() == found[1].tobytes()


def test_code_without_distinctions_stays_as_it_is() -> None:
    x, c, s = ca.SX.sym("x"), ca.SX.sym("c"), ca.SX.sym("s")
    source = generated(ca.Function("step", [x, c, s], [x * c + s, ca.exp(x)]))
    assert with_branches(source) == source
