"""CasADi's expressions as text of another language: the plant's equations are read there, not written again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

#: How tightly operators bind, as in all target languages.
_ATOM, _UNARY, _PRODUCT, _SUM, _COMPARE, _AND = 9, 8, 7, 6, 4, 3
_INFIX = {
    ca.OP_ADD: ("+", _SUM), ca.OP_SUB: ("-", _SUM), ca.OP_MUL: ("*", _PRODUCT), ca.OP_DIV: ("/", _PRODUCT),
    ca.OP_LT: ("<", _COMPARE), ca.OP_LE: ("<=", _COMPARE), ca.OP_EQ: ("==", _COMPARE), ca.OP_NE: ("!=", _COMPARE),
}  # fmt: skip
_FUNCTIONS = {
    ca.OP_SIN: "sin", ca.OP_COS: "cos", ca.OP_TAN: "tan", ca.OP_EXP: "exp", ca.OP_LOG: "log", ca.OP_SQRT: "sqrt",
    ca.OP_FABS: "abs", ca.OP_SIGN: "sign", ca.OP_FMIN: "min", ca.OP_FMAX: "max", ca.OP_TANH: "tanh",
    ca.OP_ATAN2: "atan2",
}  # fmt: skip


@dataclass(frozen=True)
class Language:
    """How a language writes what languages write differently.

    Attributes:
        functions: names that are not those of `_FUNCTIONS`' values.
        choice: of a condition, and what holds with and without it.
        negation: of a condition.
        both: of two conditions.
        different: the operator.
    """

    functions: Mapping[str, str]
    choice: str
    negation: str
    both: str
    different: str = "!="


PYTHON = Language({name: f"np.{name}" for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "sign", "tanh")} |
                  {"atan2": "np.arctan2"}, "({1} if {0} else {2})", "not {0}", "{0} and {1}")  # fmt: skip
MODELICA = Language({}, "(if {0} then {1} else {2})", "not {0}", "{0} and {1}", "<>")
MATLAB = Language({}, "(({0}) * ({1}) + (1 - ({0})) * ({2}))", "~{0}", "{0} & {1}", "~=")


def _bracketed(part: tuple[str, int], least: int) -> str:
    return part[0] if part[1] >= least else f"({part[0]})"


def as_text(expression: ca.SX, symbols: Sequence[ca.SX], language: Language) -> str:
    """One scalar expression.

    Raises:
        NotImplementedError: it has an operation that no effect has had so far.
    """
    function = ca.Function("f", [ca.vertcat(*symbols)], [ca.densify(ca.SX(expression))])
    work: dict[int, tuple[str, int]] = {}
    result = "0"
    for k in range(function.n_instructions()):
        op, inputs, outputs = (
            function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        )  # fmt: skip
        if op == ca.OP_OUTPUT:
            result = work[inputs[0]][0]
        elif op == ca.OP_INPUT:
            work[outputs[0]] = (str(symbols[inputs[1]].name()), _ATOM)
        elif op == ca.OP_CONST:
            value = function.instruction_constant(k)
            text = f"{value:.12g}"
            work[outputs[0]] = (text, _ATOM if value >= 0 else _SUM)
        else:
            work[outputs[0]] = _operation(op, [work[j] for j in inputs], language)
    return result


def _operation(op: int, parts: list[tuple[str, int]], language: Language) -> tuple[str, int]:
    if op in _INFIX:
        sign, level = _INFIX[op]
        sign = language.different if sign == "!=" else sign
        # What stands right of a minus or a fraction bar keeps its brackets.
        return f"{_bracketed(parts[0], level)} {sign} {_bracketed(parts[1], level + 1)}", level
    if op in _FUNCTIONS:
        name = _FUNCTIONS[op]
        return f"{language.functions.get(name, name)}({', '.join(p[0] for p in parts)})", _ATOM
    simple = {
        ca.OP_NEG: lambda a: (f"-{_bracketed(a, _UNARY)}", _SUM),
        ca.OP_SQ: lambda a: (f"{_bracketed(a, _PRODUCT)} * {_bracketed(a, _UNARY)}", _PRODUCT),
        ca.OP_TWICE: lambda a: (f"2 * {_bracketed(a, _UNARY)}", _PRODUCT),
        ca.OP_INV: lambda a: (f"1 / {_bracketed(a, _UNARY)}", _PRODUCT),
        ca.OP_NOT: lambda a: (language.negation.format(_bracketed(a, _ATOM)), _AND),
    }
    if op in simple:
        return simple[op](parts[0])
    if op == ca.OP_IF_ELSE_ZERO:
        return language.choice.format(parts[0][0], parts[1][0], "0"), _ATOM
    if op == ca.OP_AND:
        return language.both.format(_bracketed(parts[0], _AND + 1), _bracketed(parts[1], _AND + 1)), _AND
    raise NotImplementedError(f"CasADi operation {op} in an effect's term: add it to expressions.py")
