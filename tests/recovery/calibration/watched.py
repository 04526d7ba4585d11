"""Reads off what a threshold is compared with, while the program runs as it is.

A threshold is a module's constant. In its place stands a `float` that computes as the number does and, where something
is compared with it, notes that something on the threshold's own scale: of `error < 0.1 + LIMIT * size` that is
(error − 0.1)/size. So the statistic is the program's, not a second version of it.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Inverse = Callable[[Any], Any]
_COMPARISONS: dict[str, Callable[[Any, float], Any]] = {
    "__lt__": lambda other, own: own < other,
    "__le__": lambda other, own: own <= other,
    "__gt__": lambda other, own: own > other,
    "__ge__": lambda other, own: own >= other,
}
_NUMBERS = (int, float, np.number, np.ndarray)
#: Of an array that is compared at once so many values are kept, spread evenly.
_KEPT = 50
#: What is computed in more steps than these is a state that a threshold once limited, not the threshold.
_STEPS = 4
_ROOM = "servo_daemon."


@dataclass
class Notes:
    """What one threshold was compared with."""

    value: float
    seen: list[float] = field(default_factory=list)

    def take(self, statistic: Any) -> None:
        flat = np.ravel(np.asarray(statistic, dtype=np.float64))
        flat = flat[np.isfinite(flat)]
        if len(flat) > _KEPT:
            flat = np.sort(flat)[np.linspace(0, len(flat) - 1, _KEPT).astype(int)]
        self.seen.extend(flat.tolist())


class Watched(float):
    """See the module. `notes` takes what is seen, `inverse` brings it to the threshold's scale after `steps`."""

    notes: Notes
    inverse: Inverse
    steps: int

    @classmethod
    def of(cls, value: float, notes: Notes, inverse: Inverse = lambda y: y, steps: int = 0) -> Watched:
        own = cls(value)
        own.notes, own.inverse, own.steps = notes, inverse, steps
        return own

    def _derived(self, k: Any, forth: Callable[[Any, Any], Any], back: Callable[[Any, Any], Any]) -> Any:
        """forth(threshold, k); `back` undoes it."""
        if not isinstance(k, _NUMBERS):
            return NotImplemented
        plain = np.float64(k) if np.ndim(k) == 0 else k
        with np.errstate(all="ignore"):
            value = forth(float(self), k if np.ndim(k) else float(k))
        if isinstance(k, Watched) or np.ndim(k) or self.steps >= _STEPS:
            return value
        inverse = self.inverse
        return Watched.of(float(value), self.notes, lambda y: inverse(back(y, plain)), self.steps + 1)

    def _note(self, other: Any) -> None:
        if not isinstance(other, Watched):
            with np.errstate(all="ignore"):
                self.notes.take(self.inverse(np.asarray(other, dtype=np.float64)))

    def __mul__(self, k: Any) -> Any:
        return self._derived(k, lambda x, k: x * k, lambda y, k: y / k)

    def __add__(self, k: Any) -> Any:
        return self._derived(k, lambda x, k: x + k, lambda y, k: y - k)

    def __sub__(self, k: Any) -> Any:
        return self._derived(k, lambda x, k: x - k, lambda y, k: y + k)

    def __rsub__(self, k: Any) -> Any:
        return self._derived(k, lambda x, k: k - x, lambda y, k: k - y)

    def __truediv__(self, k: Any) -> Any:
        return self._derived(k, lambda x, k: x / k, lambda y, k: y * k)

    def __rtruediv__(self, k: Any) -> Any:
        return self._derived(k, lambda x, k: k / x, lambda y, k: k / y)

    def __pow__(self, k: Any, _: Any = None) -> Any:
        return self._derived(k, lambda x, k: x**k, lambda y, k: np.sign(y) * np.abs(y) ** (1.0 / k))

    def __neg__(self) -> Any:
        return self._derived(-1.0, lambda x, k: x * k, lambda y, k: y / k)

    __rmul__, __radd__ = __mul__, __add__

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        """NumPy's operators come here: those of two numbers as above, all others with the plain number."""
        own = {np.less: "__gt__", np.less_equal: "__ge__", np.greater: "__lt__", np.greater_equal: "__le__"}
        other = {np.less: "__lt__", np.less_equal: "__le__", np.greater: "__gt__", np.greater_equal: "__ge__"}
        if method == "__call__" and len(inputs) == 2 and not kwargs and ufunc in own:
            first, second = inputs
            if isinstance(second, Watched):
                return getattr(second, own[ufunc])(first)
            return getattr(first, other[ufunc])(second)
        if method == "__call__" and len(inputs) == 2 and not kwargs and np.ndim(inputs[0]) == np.ndim(inputs[1]) == 0:
            names = {np.multiply: "__rmul__", np.add: "__radd__", np.subtract: "__rsub__", np.divide: "__rtruediv__"}
            if ufunc in names and isinstance(inputs[1], Watched) and not isinstance(inputs[0], Watched):
                return getattr(inputs[1], names[ufunc])(float(inputs[0]))
        plain = [float(x) if isinstance(x, Watched) else x for x in inputs]
        return getattr(ufunc, method)(*plain, **kwargs)

    def __reduce__(self) -> tuple[type[float], tuple[float]]:
        return float, (float(self),)


def _comparison(name: str) -> Callable[[Watched, Any], Any]:
    def compare(self: Watched, other: Any) -> Any:
        if not isinstance(other, _NUMBERS):
            return NotImplemented
        self._note(other)
        return _COMPARISONS[name](float(other) if isinstance(other, Watched) else other, float(self))

    return compare


for _name in _COMPARISONS:
    setattr(Watched, _name, _comparison(_name))


def thresholds(package: str) -> Iterator[tuple[Any, str, Any]]:
    """Modules of a package, and names and values of the constants that each defines."""
    for info in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
        if info.ispkg:
            continue
        module = importlib.import_module(info.name)
        for statement in ast.parse(inspect.getsource(module)).body:
            targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
            for node in (n for t in targets if t is not None for n in ast.walk(t)):
                if isinstance(node, ast.Name) and node.id.lstrip("_").isupper():
                    yield module, node.id, vars(module)[node.id]


def _wrapped(name: str, value: Any, notes: dict[str, Notes]) -> Any:
    if type(value) is float:
        return Watched.of(value, notes.setdefault(name, Notes(value)))
    if type(value) is tuple and value and all(type(v) is float for v in value):
        return tuple(_wrapped(f"{name}[{k}]", v, notes) for k, v in enumerate(value))
    if type(value) is dict and value and all(type(v) is float for v in value.values()):
        return {k: _wrapped(f"{name}[{k}]", v, notes) for k, v in value.items()}
    return value


@contextmanager
def watching(*packages: str) -> Iterator[dict[str, Notes]]:
    """Notes of all thresholds of packages by "package.module.NAME" (without servo_daemon), wherever they were imported
    to, while it lasts."""
    notes: dict[str, Notes] = {}
    wrapped = [
        (name, value, _wrapped(f"{where.__name__.removeprefix(_ROOM)}.{name}", value, notes))
        for package in packages
        for where, name, value in thresholds(package)
    ]
    with put(wrapped):
        yield notes


@contextmanager
def put(constants: Iterable[tuple[str, Any, Any]]) -> Iterator[None]:
    """Names, values, and what every module of the project that holds such a one holds instead while it lasts."""
    replaced: list[tuple[Any, str, Any]] = []
    own = [m for n, m in list(sys.modules.items()) if n.split(".")[0] == "servo_daemon" and m is not None]
    try:
        for name, value, new in constants:
            if new is value:
                continue
            for module in own:
                if vars(module).get(name) is value:
                    replaced.append((module, name, value))
                    setattr(module, name, new)
        yield
    finally:
        for module, name, value in replaced:
            setattr(module, name, value)
