"""The C code of a step and of the loop around it: made, compiled once, and kept in a cache by its content's hash."""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
import threading
from collections import defaultdict
from functools import cache
from pathlib import Path

import casadi as ca

from servo_daemon.plant.c_code.branches import with_branches
from servo_daemon.plant.c_code.lanes import in_lanes
from servo_daemon.plant.c_code.loop import LOOP, ONCE, with_memory, without_questions

log = logging.getLogger(__name__)

#: Long steps (substeps, sensitivities) compile four times as fast this way and run as fast. (With the second flag gcc
#: clears the upper halves of vector registers before a call of the library, without which it crawls: up to four times
#: as long to run.) Of shorter ones four run at once, too, where they are wanted: a third to all as long again to
#: compile, a half to a quarter as long to run.
_LONG_SOURCE, _LONG_FLAGS = 400_000, ("-O1", "-fexpensive-optimizations")
#: Without `-fno-semantic-interposition` each square and each absolute value is a call through a table: 7 % slower.
_FLAGS = ("-O2", "-fno-semantic-interposition", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared", "-w")
#: Less than this share of a step's operations is computed again as fast as it is looked up (measured: a cogging
#: motor's sensitivities, 8 %, take a quarter longer; a gap's simulation, 21 %, a seventh less).
_WORTH_PREPARING = 0.15
#: In longer code (sensitivities) calls of the library are a small part of the time, and looking whether they are needed
#: costs half as much again to compile.
_SHORT_SOURCE = 80_000
#: One for each function: threads that need the same code wait for it, others compile beside them.
_build_locks: defaultdict[Path, threading.Lock] = defaultdict(threading.Lock)


def find_compiler() -> str | None:
    """Path of a C compiler, or None. `SERVO_DAEMON_CC` names one; set empty it forces the virtual machine."""
    wanted = os.environ.get("SERVO_DAEMON_CC")
    if wanted is not None:
        return shutil.which(wanted) if wanted else None
    return next((path for name in ("cc", "gcc", "clang", "tcc") if (path := shutil.which(name))), None)


def cache_directory() -> Path:
    """Where compiled code is kept: systemd's CACHE_DIRECTORY, else the user's cache. Created private."""
    base = os.environ.get("CACHE_DIRECTORY") or os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    path = Path(base.split(":")[0]) / "servo-daemon"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(path, os.W_OK):
            return path
    except OSError:
        pass
    return _private_temporary()


@cache
def _private_temporary() -> Path:
    """A directory of this process alone, for machines where no cache can be written."""
    return Path(tempfile.mkdtemp(prefix="servo-daemon-"))


@cache
def _compiler_version(compiler: str) -> str:
    result = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False)
    return result.stdout


@cache
def _processor_flags(compiler: str) -> tuple[str, ...]:
    """Three-operand instructions where this processor has them: 13 % faster, the same numbers (they are no fused
    ones). Part of the cache's key, like every flag."""
    if platform.machine() != "x86_64" or "tcc" in _compiler_version(compiler):
        return ()
    try:
        flags = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags"))
    except (OSError, StopIteration):
        return ()
    return ("-mavx",) if "avx" in flags.split() else ()


def _generate(function: ca.Function, paced_by: int | None, side_by_side: bool) -> str:
    """C source of the step and the loop around it."""
    generator = ca.CodeGenerator("step.c", {"with_header": False})
    prepare, step = (None, function) if paced_by is None else split(function, paced_by)
    sizes = {
        "STATE": function.numel_in(0),
        "CONSTANTS": function.numel_in(1),
        "SAMPLE": function.numel_in(2),
        "OUTPUT": function.numel_out(1),
        "PACE": paced_by or 0,
        "PREPARED": 0 if prepare is None else prepare.numel_out(0),
    }
    functions = [step] if prepare is None else [prepare, step]
    for f in functions:
        generator.add(f)
    sizes |= {
        "ARG": max(f.sz_arg() for f in functions),
        "RES": max(f.sz_res() for f in functions),
        "IW": max(f.sz_iw() for f in functions),
        "W": max(f.sz_w() for f in functions),
    }
    defines = "\n".join(f"#define SD_{name} {value}" for name, value in sizes.items())
    # glibc exports a function `step` of its own (regexp.h of old), which would be called instead of ours.
    rename = "#define step servo_daemon_step\n#define prepare servo_daemon_prepare"
    source, lanes = without_questions(generator.dump()), ""
    if len(source) < _SHORT_SOURCE:
        source = with_memory(source)
    if len(source) < _LONG_SOURCE:
        lanes = in_lanes(source) if side_by_side else ""
        source = with_branches(source)  # (of longer code: a tenth faster, compiled almost three times as long)
    return f"{rename}\n{defines}\n{ONCE}\n{source}\nenum {{ SD_ONCES = __COUNTER__ }};\n{lanes}\n{LOOP}"


def split(function: ca.Function, paced_by: int) -> tuple[ca.Function | None, ca.Function]:
    """A step as two: what depends on the constants and one element of the sample alone, and the rest. The operations
    are the same. None: there is too little of that.

    Args:
        function: (state, constants, sample) -> (state, output).
        paced_by: which element of the sample, its length in time.

    Returns:
        (constants, length) -> prepared, and (state, constants, sample, prepared) -> (state, output).
    """
    symbols = [ca.SX.sym(f"a{k}", function.numel_in(k)) for k in range(3)]
    results, names, prepared = ca.extract_parametric(list(function(*symbols)), [symbols[1], symbols[2][paced_by]], {})
    prepare = ca.Function("prepare", [symbols[1], symbols[2][paced_by]], [ca.vertcat(*prepared)] if names else [])
    if prepare.n_instructions() < _WORTH_PREPARING * function.n_instructions():
        return None, function
    return prepare, ca.Function("step", [*symbols, ca.vertcat(*names)], results)


def compile_step(function: ca.Function, compiler: str, paced_by: int | None, side_by_side: bool) -> ctypes.CDLL:
    """The shared library of this function, from the cache or compiled now.

    Args:
        paced_by, side_by_side: see `SampleLoop`.

    Raises:
        OSError, subprocess.SubprocessError: no library could be made or loaded.
    """
    source = _generate(function, paced_by, side_by_side)
    flags = (*_FLAGS, *_processor_flags(compiler), *(_LONG_FLAGS if len(source) > _LONG_SOURCE else ()))
    key = "\n".join((source, compiler, _compiler_version(compiler), " ".join(flags), platform.machine()))
    path = cache_directory() / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.so"
    with _build_locks[path]:
        if path.exists():
            try:
                return ctypes.CDLL(str(path))
            except OSError as error:  # damaged on disk: it is only a cache
                log.warning("%s cannot be loaded (%s): compiling it again", path, error)
        with tempfile.TemporaryDirectory(dir=path.parent) as directory:
            c_file, so_file = Path(directory) / "step.c", Path(directory) / "step.so"
            c_file.write_text(source, encoding="utf-8")
            command = [compiler, *flags, str(c_file), "-o", str(so_file), "-lm"]
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=120)
            so_file.replace(path)
        return ctypes.CDLL(str(path))
