"""The C code as a function on arrays: compiled once, kept by content hash, called through ctypes."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_HERE = Path(__file__).resolve().parent
_SOURCES = ("motor.c", "drive.c")
# No contraction and no fast-math: the same numbers from every compiler.
_FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-ffp-contract=off", "-fPIC", "-shared")


class CompilerMissingError(RuntimeError):
    """There is no C compiler, so the generator cannot be built."""


class IntegrationError(RuntimeError):
    """Events follow each other without end, or a state is no longer a finite number."""


def find_compiler() -> str | None:
    """The C compiler: `CC`, else cc, gcc or clang; None without one."""
    named = os.environ.get("CC", "").split()
    return next((path for name in (*named[:1], "cc", "gcc", "clang") if (path := shutil.which(name))), None)


def _cache_directory() -> Path:
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "servo-daemon-tests"
    try:
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return Path(tempfile.mkdtemp(prefix="servo-daemon-tests-"))
    return base if os.access(base, os.W_OK) else Path(tempfile.mkdtemp(prefix="servo-daemon-tests-"))


@cache
def library() -> ctypes.CDLL:
    """The compiled generator.

    Raises:
        CompilerMissingError: no C compiler on this machine.
        RuntimeError: the compiler refused the source; says why.
    """
    compiler = find_compiler()
    if compiler is None:
        raise CompilerMissingError("the test-data generator needs a C compiler (cc, gcc, clang or $CC): there is none")
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
    digest = hashlib.sha256("\n".join((compiler, version, platform.machine(), *_FLAGS)).encode())
    for name in ("motor.h", *_SOURCES):
        digest.update((_HERE / name).read_bytes())
    path = _cache_directory() / f"generator-{digest.hexdigest()[:24]}.so"
    if not path.exists():
        _compile(compiler, path)
    loaded = ctypes.CDLL(str(path))
    loaded.generate.restype = ctypes.c_long
    loaded.generate.argtypes = [ctypes.c_long, *[ctypes.c_void_p] * 4]
    return loaded


def _compile(compiler: str, path: Path) -> None:
    """Into a temporary name first: two test processes may build at the same time."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        built = Path(folder) / path.name
        command = [compiler, *_FLAGS, *(str(_HERE / name) for name in _SOURCES), "-o", str(built), "-lm"]
        result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
        if result.returncode:
            raise RuntimeError(f"{' '.join(command)} failed:\n{result.stderr}")
        built.replace(path)


@cache
def fields(table: str) -> tuple[str, ...]:
    """Names in the order of the C struct; `table` is "setup", "input" or "output"."""
    function: Any = getattr(library(), f"{table}_fields")
    function.restype = ctypes.c_char_p
    return tuple(function().decode().split())


def run(setup: Mapping[str, float], inputs: Mapping[str, F64 | float], noise: F64 | None) -> dict[str, F64]:
    """Integrates over all samples.

    Args:
        setup: fields of Setup; what is absent is 0.
        inputs: fields of Input, all of them, shape (n,) or a constant; "time" is an array.
        noise: hidden voltage, V, shape (n, noise_pieces), or None.

    Returns:
        fields of Output, shape (n,) each.

    Raises:
        ValueError: an unknown or missing field, or a shape that does not fit.
        IntegrationError: the motion could not be followed.
    """
    if unknown := set(setup) - set(fields("setup")):
        raise ValueError(f"not in Setup: {', '.join(sorted(unknown))}")
    if set(inputs) != set(fields("input")):
        raise ValueError(f"inputs are {', '.join(fields('input'))}, not {', '.join(inputs)}")
    n = len(np.asarray(inputs["time"]))
    values = np.array([float(setup.get(name, 0.0)) for name in fields("setup")])
    table = np.empty((n, len(fields("input"))))
    for k, name in enumerate(fields("input")):
        table[:, k] = inputs[name]
    output = np.zeros((n, len(fields("output"))))
    hidden = None if noise is None else np.ascontiguousarray(noise, dtype=np.float64)
    if hidden is not None and hidden.shape != (n, int(setup["noise_pieces"])):
        raise ValueError(f"noise has the shape {hidden.shape}, not {(n, int(setup['noise_pieces']))}")
    address = None if hidden is None else hidden.ctypes.data
    stuck = library().generate(n, values.ctypes.data, table.ctypes.data, address, output.ctypes.data)
    if stuck:
        raise IntegrationError(f"events without end before sample {stuck} of {n}")
    if not np.isfinite(output).all():
        raise IntegrationError(f"not finite from sample {int(np.argmin(np.isfinite(output).all(axis=1)))} of {n}")
    return {name: output[:, k].copy() for k, name in enumerate(fields("output"))}
