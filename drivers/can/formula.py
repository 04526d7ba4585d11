"""Formulas in a signal map, such as "Duty * Supply": arithmetic over NumPy arrays and nothing else.

The text is parsed with `ast` and every node is checked against a short list when the configuration is read; no code is
ever evaluated, so a configuration file cannot do more than arithmetic.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from servo_daemon.errors import DriverConfigError
from servo_daemon.samples import F64

_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: np.true_divide,
}
_UNARY: dict[type[ast.unaryop], Callable[[Any], Any]] = {ast.UAdd: operator.pos, ast.USub: operator.neg}
_FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "abs": (1, np.abs),
    "sqrt": (1, np.sqrt),
    "sin": (1, np.sin),
    "cos": (1, np.cos),
    "sign": (1, np.sign),
    "min": (2, np.minimum),
    "max": (2, np.maximum),
}

#: Longer than any sensible formula, and short enough for the parser's and our own recursion.
MAX_LENGTH = 500


@dataclass(frozen=True, slots=True)
class Formula:
    """A checked formula.

    Attributes:
        text: as written.
        names: the operands in it, sorted.
        body: the checked syntax tree.
    """

    text: str
    names: tuple[str, ...]
    body: ast.expr

    def __call__(self, operands: Mapping[str, F64]) -> F64:
        """The value over whole blocks.

        Args:
            operands: array of shape (n,) for each of `names`.

        Returns:
            Shape (n,), or a scalar for a formula without operands; not finite where it has no value (1 / 0).
        """
        with np.errstate(all="ignore"):
            return np.asarray(_value(self.body, operands), np.float64)


def parse_formula(text: str, where: str) -> Formula:
    """Check a formula: + - * /, parentheses, numbers, names and abs sqrt sin cos sign min max.

    Raises:
        DriverConfigError: anything else; the text says what and where.
    """
    if len(text) > MAX_LENGTH:
        raise DriverConfigError(f"{where}: a formula has at most {MAX_LENGTH} characters")
    try:
        body = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise DriverConfigError(f"{where}: {text!r} is no formula: {error}") from error
    names: set[str] = set()
    try:
        _check(body, names)
    except ValueError as error:
        raise DriverConfigError(f"{where}: {text!r}: {error}") from error
    return Formula(text, tuple(sorted(names)), body)


def _check(node: ast.expr, names: set[str]) -> None:
    match node:
        case ast.Constant(value=bool()):
            raise ValueError("True and False are not allowed")
        case ast.Constant(value=int() | float() as value):
            if abs(value) > 1e300 or not math.isfinite(value):
                raise ValueError("a number is out of range")
        case ast.Name(id=name):
            names.add(name)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            _check(left, names)
            _check(right, names)
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _UNARY:
            _check(operand, names)
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in _FUNCTIONS:
            if len(args) != _FUNCTIONS[name][0]:
                raise ValueError(f"{name}() takes {_FUNCTIONS[name][0]} argument(s), not {len(args)}")
            for argument in args:
                _check(argument, names)
        case _:
            raise ValueError(
                f"'{ast.unparse(node)}' is not allowed: only + - * /, parentheses, numbers, names and "
                + ", ".join(f"{name}()" for name in _FUNCTIONS)
            )


def _value(node: ast.expr, operands: Mapping[str, F64]) -> Any:
    match node:
        case ast.Constant(value=value):
            return np.float64(value)  # type: ignore[arg-type]  # `_check` let only numbers through
        case ast.Name(id=name):
            return operands[name]
        case ast.BinOp(left=left, op=op, right=right):
            return _BINARY[type(op)](_value(left, operands), _value(right, operands))
        case ast.UnaryOp(op=op, operand=operand):
            return _UNARY[type(op)](_value(operand, operands))
        case ast.Call(func=ast.Name(id=name), args=args):
            return _FUNCTIONS[name][1](*(_value(a, operands) for a in args))
    raise AssertionError(f"unchecked node {ast.dump(node)}")
