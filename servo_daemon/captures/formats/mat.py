"""MATLAB's MAT files (versions 4 to 7) by scipy: variables, structs, what Simulink's "To Workspace" leaves.

A signal is a path as MATLAB writes it: `speed`, `log.current`, `out.signals(2).values`. A matrix needs a `column` (or
`row`), counted from 1. Where a struct holds a vector `time` (or `Time`), as Simulink's "Structure With Time" and a
timeseries turned into a struct do, it is the time of every signal in that struct that has as many samples.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from servo_daemon.captures.capture.bounded import check_cells
from servo_daemon.captures.capture.model import capture_error
from servo_daemon.captures.columns.foreign import Series
from servo_daemon.captures.columns.held import HeldSignal
from servo_daemon.captures.columns.recording import parser_failed
from servo_daemon.captures.columns.signal_map import SignalRef
from servo_daemon.errors import CaptureError
from servo_daemon.samples import F64

_TIME_NAMES = ("time", "Time")
_FUNCTION = "function handle"
_STEP = re.compile(r"([A-Za-z]\w*)((?:\(\d+\))?)")


@dataclass(frozen=True, slots=True)
class MatRecording:
    """The variables of a MAT file.

    Attributes:
        tree: nested dicts (structs), lists (struct arrays, cells) and arrays.
        held: what is numeric in it and longer than one value.
        objects: variables that are objects of MATLAB classes, with the class: scipy cannot read them.
    """

    kind: ClassVar[str] = "MAT files"
    options: ClassVar[tuple[str, ...]] = ("time_base",)
    header_line: ClassVar[int | None] = None
    told: ClassVar[tuple[str, ...]] = ()

    path: Path
    tree: Mapping[str, Any]
    held: tuple[HeldSignal, ...]
    objects: Mapping[str, str]
    metadata: Mapping[str, str]
    timed: bool = False

    def read(self, ref: SignalRef) -> Series:
        node, clock = self._find(ref)
        if isinstance(node, Mapping):  # a timeseries turned into a struct
            clock = _clock(node)
            node = next((node[key] for key in ("data", "Data") if key in node), None)
        array = _numbers(node)
        if array is None:
            raise capture_error(self.path, f"holds {_what(node)}, not numbers", column=ref.label)
        vector = self._vector(array, ref)
        own = clock if clock is not None and len(clock) == len(vector) else None
        return Series(vector, own)

    def place(self, index: int) -> str:
        return f"sample {index + 1}"

    def _find(self, ref: SignalRef) -> tuple[Any, F64 | None]:
        """The value at a path, and the time of the innermost struct around it that has one."""
        if ref.group is not None:
            raise capture_error(self.path, "'group' is for MDF files: give the whole path", column=ref.label)
        node: Any = self.tree
        clock: F64 | None = None
        for step in ref.signal.split("."):
            match = _STEP.fullmatch(step.strip())
            node = node.get(match[1]) if match and isinstance(node, Mapping) else None
            if match and match[2]:
                number = int(match[2][1:-1])
                items = node if isinstance(node, list) else [node]
                node = items[number - 1] if 1 <= number <= len(items) else None
            if node is None:
                root = ref.signal.partition(".")[0]
                if root in self.objects:
                    raise capture_error(self.path, _object_help(root, self.objects[root]), column=ref.label)
                names = ", ".join(signal.name for signal in self.held[:16]) or "none"
                raise capture_error(self.path, f"no such signal; there are {names}", column=ref.label)
            if isinstance(node, Mapping) and (own := _clock(node)) is not None:
                clock = own
        return node, clock

    def _vector(self, array: F64, ref: SignalRef) -> F64:
        """One signal out of an array."""
        if ref.column is None and ref.row is None:
            if array.ndim != 1:
                raise capture_error(
                    self.path, f"a matrix of {_size(array)}: say which column (or row) of it", column=ref.label
                )
            return array
        matrix = np.atleast_2d(array.T).T if array.ndim < 2 else array
        if matrix.ndim != 2:
            raise capture_error(self.path, f"has {array.ndim} dimensions, {_size(array)}", column=ref.label)
        axis, number = (1, ref.column) if ref.column is not None else (0, ref.row)
        assert number is not None
        if number > matrix.shape[axis]:
            raise capture_error(self.path, f"a matrix of {_size(matrix)} has no such part", column=ref.label)
        return np.ascontiguousarray(np.take(matrix, number - 1, axis))


def read_mat(path: Path, raw: BinaryIO) -> MatRecording:
    """The variables of an open MAT file.

    Raises:
        CaptureError: damaged, or of version 7.3 (HDF5), or with objects of MATLAB classes only.
    """
    from scipy.io import loadmat, whosmat

    raw.seek(0)
    head = raw.read(128)
    if b"MATLAB 7.3" in head or head.startswith(b"\x89HDF"):
        raise capture_error(path, "a MAT file of version 7.3 (HDF5): save it with  save('name.mat', …, '-v7')")
    raw.seek(0)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of variables scipy cannot read, which are named below where it matters
            check_cells(path, sum(math.prod(shape) for _, shape, _ in whosmat(raw)), 1)
            raw.seek(0)
            content = loadmat(raw, simplify_cells=True)
    except CaptureError:
        raise
    except Exception as error:  # the parser raises whatever the bytes make it stumble over
        raise parser_failed(path, "MAT file", error) from error
    variables = {k: v for k, v in content.items() if isinstance(k, str) and not k.startswith("__")}
    objects = {k: c for k, v in variables.items() if (c := _class_of(v)) is not None}
    tree = {k: v for k, v in variables.items() if k not in objects}
    held = tuple(_leaves(tree, ""))
    if not held and objects:
        name, class_name = next(iter(objects.items()))
        raise capture_error(path, _object_help(name, class_name))
    return MatRecording(path, tree, _with_plain_names(tree, held), objects, {})


def _with_plain_names(tree: Mapping[str, Any], held: tuple[HeldSignal, ...]) -> tuple[HeldSignal, ...]:
    """Where one struct holds everything, its fields are as good as variables of their own."""
    structs = [key for key, node in tree.items() if isinstance(node, Mapping)]
    if len(structs) != 1 or "time_s" in tree:
        return held
    prefix = f"{structs[0]}."
    return tuple(replace(signal, plain=signal.name.removeprefix(prefix)) for signal in held)


def _leaves(node: Any, path: str) -> Iterator[HeldSignal]:
    """Everything numeric and longer than one value."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            yield from _leaves(value, f"{path}.{key}" if path else str(key))
    elif isinstance(node, list):
        for number, value in enumerate(node, 1):
            yield from _leaves(value, f"{path}({number})")
    elif (array := _numbers(node)) is not None and array.size > 1:
        yield HeldSignal(path, _size(array), columns=array.shape[1] if array.ndim == 2 else 0)


def _numbers(node: Any) -> F64 | None:
    """A real numeric array as doubles, at least one-dimensional; None: it is none."""
    try:
        array = np.atleast_1d(np.asarray(node))
    except ValueError:  # cells of unequal sizes
        return None
    if isinstance(node, list | Mapping) or array.dtype.kind not in "biuf":
        return None
    return array.astype(np.float64)


def _clock(struct: Mapping[str, Any]) -> F64 | None:
    """The vector `time` of a struct, where there is one."""
    for name in _TIME_NAMES:
        array = _numbers(struct[name]) if name in struct else None
        if array is not None and array.ndim == 1 and len(array) > 1:
            return array
    return None


def _size(array: F64) -> str:
    return " × ".join(str(n) for n in array.shape)


def _what(node: Any) -> str:
    if isinstance(node, str):
        return "text"
    if isinstance(node, Mapping) or node is None:
        return "a struct without data"
    if isinstance(node, list):
        return f"{len(node)} structs or cells: write it as name(1)"
    return "complex numbers" if np.asarray(node).dtype.kind == "c" else "no real numbers"


def _class_of(value: Any) -> str | None:
    """The class of a MATLAB object, of which scipy has the name only; None: the value is none."""
    from scipy.io.matlab import MatlabFunction, MatlabOpaque

    if isinstance(value, MatlabFunction):
        return _FUNCTION
    names = getattr(getattr(value, "dtype", None), "names", None) or ()
    if isinstance(value, MatlabOpaque) or {"s0", "s1", "s2", "arr"} <= set(names):
        item = np.atleast_1d(value)[0]
        kind = item["s2"]
        return kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)
    return None


def _object_help(name: str, class_name: str) -> str:
    what = f"{name} is a MATLAB object (class {class_name}), which only MATLAB can read"
    if class_name == _FUNCTION:
        return what
    return (
        f"{what}; of a timeseries make there  s = struct('time', {name}.Time, 'data', {name}.Data); "
        "save('name.mat', 's', '-v7')"
    )
