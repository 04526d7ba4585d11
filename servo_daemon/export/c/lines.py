"""A CasADi function as lines of C99 in single precision: no array but the arguments, no call into CasADi."""

from __future__ import annotations

import math
from collections.abc import Sequence

import casadi as ca

_BINARY = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_LT: "{0} < {1}",
    ca.OP_LE: "{0} <= {1}",
    ca.OP_EQ: "{0} == {1}",
    ca.OP_AND: "{0} && {1}",
    ca.OP_OR: "{0} || {1}",
    ca.OP_FMIN: "servo_min({0}, {1})",
    ca.OP_FMAX: "servo_max({0}, {1})",
    ca.OP_IF_ELSE_ZERO: "{0} ? {1} : 0.0f",
}
_UNARY = {ca.OP_NEG: "-{0}", ca.OP_SQ: "{0} * {0}", ca.OP_TWICE: "2.0f * {0}", ca.OP_INV: "1.0f / {0}",
          ca.OP_FABS: "servo_abs({0})", ca.OP_NOT: "!{0}", ca.OP_SIGN: "servo_sign({0})"}  # fmt: skip
_LOGICAL = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NOT, ca.OP_AND, ca.OP_OR)


#: The plant's guards against a division by zero are smaller: their squares must be numbers in single precision, too.
_SMALLEST = 1e-18


def literal(value: float) -> str:
    """A constant of single precision."""
    if 0.0 < abs(value) < _SMALLEST:
        value = math.copysign(_SMALLEST, value)
    text = f"{value:.9g}"
    return f"{text}f" if any(c in text for c in ".en") else f"{text}.0f"


def c_lines(function: ca.Function, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
    """The body of a C function.

    Args:
        function: of SX.
        inputs: names of the arguments, an array each; a scalar one begins with "=".
        outputs: names of the arrays that are written.

    Raises:
        NotImplementedError: an operation that no estimator has had so far.
    """
    work: dict[int, str] = {}
    lines = []
    for k in range(function.n_instructions()):
        op, into, out = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
        if op == ca.OP_OUTPUT:
            lines.append(f"{outputs[into[0]]}[{into[1]}] = {work[out[0]]};")
        elif op == ca.OP_INPUT:
            name = inputs[out[0]]
            work[into[0]] = name[1:] if name.startswith("=") else f"{name}[{out[1]}]"
        elif op == ca.OP_CONST:
            work[into[0]] = literal(function.instruction_constant(k))
        else:
            pattern = _BINARY.get(op) or _UNARY.get(op)
            if pattern is None:
                raise NotImplementedError(f"CasADi operation {op} in an estimator's step: add it to export/c/lines.py")
            kind = "int" if op in _LOGICAL else "float"
            lines.append(f"const {kind} a{k} = {pattern.format(*(work[j] for j in out))};")
            work[into[0]] = f"a{k}"
    return lines
