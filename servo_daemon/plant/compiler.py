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

log = logging.getLogger(__name__)

#: Long steps (substeps, sensitivities) compile four times as fast this way and run as fast.
_LONG_SOURCE, _LONG_FLAGS = 400_000, ("-O1",)
_FLAGS = ("-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared", "-w")
_LOOP = """
#include <string.h>
/* Appended by servo_daemon: n samples through the step, the state carried along. */
int servo_daemon_loop(long long n, double* state, const double* constants, const double* samples, double* outputs) {
  casadi_int iw[SD_IW + 1];
  double w[SD_W + 1], next[SD_STATE + 1];
  const double* arg[SD_ARG + 3];
  double* res[SD_RES + 2];
  long long k;
  for (k = 0; k < n; ++k) {
    arg[0] = state; arg[1] = constants; arg[2] = samples + k * SD_SAMPLE;
    res[0] = next; res[1] = outputs + k * SD_OUTPUT;
    if (step(arg, res, iw, w, 0)) return 1;
    memcpy(state, next, sizeof(double) * SD_STATE);
  }
  return 0;
}
/* So many runs of n samples each, side by side in memory. */
int servo_daemon_loops(long long runs, long long n, double* states, const double* constants, const double* samples,
                       double* outputs) {
  long long k;
  for (k = 0; k < runs; ++k)
    if (servo_daemon_loop(n, states + k * SD_STATE, constants, samples + k * n * SD_SAMPLE,
                          outputs + k * n * SD_OUTPUT)) return 1;
  return 0;
}
"""
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


def _generate(function: ca.Function) -> str:
    """C source of the step and the loop around it."""
    generator = ca.CodeGenerator("step.c", {"with_header": False})
    generator.add(function)
    sizes = {
        "STATE": function.numel_in(0),
        "SAMPLE": function.numel_in(2),
        "OUTPUT": function.numel_out(1),
        "ARG": function.sz_arg(),
        "RES": function.sz_res(),
        "IW": function.sz_iw(),
        "W": function.sz_w(),
    }
    defines = "\n".join(f"#define SD_{name} {value}" for name, value in sizes.items())
    # glibc exports a function `step` of its own (regexp.h of old), which would be called instead of ours.
    rename = "#define step servo_daemon_step"
    return f"{rename}\n{generator.dump()}\n{defines}\n{_LOOP}"


def compile_step(function: ca.Function, compiler: str) -> ctypes.CDLL:
    """The shared library of this function, from the cache or compiled now.

    Raises:
        OSError, subprocess.SubprocessError: no library could be made or loaded.
    """
    source = _generate(function)
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
