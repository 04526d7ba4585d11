"""The one wrapper that owns CasADi buffers: runs a step function over a block of samples, in C where a compiler exists.

A `SampleLoop` takes a CasADi function `(state, constants, sample) -> (state, output)` and runs it over an array of
samples without returning to Python. With a C compiler on the machine the function's generated C code is compiled once
and cached by content hash; without one CasADi's virtual machine runs the same expressions. Both do the same operations
in the same order (`-ffp-contract=off`, no fast-math), so the numbers are the same either way, and any partition of the
samples into blocks gives bit-identical results.
"""

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
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np

from servo_daemon.plant.at_once import cores, on_all_cores
from servo_daemon.samples import F64

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
#: Runs of fewer samples in all are not worth a second thread.
_WORTH_A_THREAD = 2_000
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


def _compile(function: ca.Function, compiler: str) -> ctypes.CDLL:
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


def _dense(function: ca.Function) -> ca.Function:
    """The same with every element of its results stored: the buffers have a place for all of them."""
    if all(function.nnz_out(k) == function.numel_out(k) for k in range(function.n_out())):
        return function
    arguments = [ca.SX.sym(f"a{k}", function.numel_in(k)) for k in range(function.n_in())]
    return ca.Function("step", arguments, [ca.densify(result) for result in function(*arguments)])


def _address(array: F64) -> int:
    """Of the first element. (`array.ctypes.data` takes four times as long, and serves what may not be written.)"""
    if array.size and array.flags.writeable:
        return ctypes.addressof(ctypes.c_double.from_buffer(array))  # type: ignore[arg-type, unused-ignore]
    return int(array.ctypes.data)


class SampleLoop:
    """A step function run over blocks of samples; the state is the caller's.

    Args:
        function: CasADi SX function named "step", (state (ns,), constants (nc,), sample (ni,)) -> (state (ns,),
            output (no,)).
        compiled: False forces the virtual machine.

    Attributes:
        backend: "c" or "vm".
    """

    _LARGEST = 256  # samples a single VM call takes; longer blocks are split

    def __init__(self, function: ca.Function, *, compiled: bool = True) -> None:
        if function.name() != "step":  # the loop in C calls it by this name
            raise ValueError(f'the function must be named "step", not {function.name()!r}')
        function = _dense(function)
        self._function = function
        self._n_state, self._n_constants = function.numel_in(0), function.numel_in(1)
        self._n_sample, self._n_output = function.numel_in(2), function.numel_out(1)
        self._library: ctypes.CDLL | None = None
        compiler = find_compiler() if compiled else None
        if compiler is not None:
            try:
                self._library = _compile(function, compiler)
                self._call = self._library.servo_daemon_loop
                self._call.restype = ctypes.c_int
                self._call.argtypes = [ctypes.c_longlong] + [ctypes.c_void_p] * 4
                self._call_many = self._library.servo_daemon_loops
                self._call_many.restype = ctypes.c_int
                self._call_many.argtypes = [ctypes.c_longlong] * 2 + [ctypes.c_void_p] * 4
            except (OSError, subprocess.SubprocessError) as error:
                detail = getattr(error, "stderr", "") or ""
                log.warning("C compilation failed (%s %s): using CasADi's virtual machine", error, detail.strip())
                self._library = None
        elif compiled:
            log.info("no C compiler found: using CasADi's virtual machine (about 5 x slower, same numbers)")
        self._machines: dict[int, _MachineBlock] = {}

    @property
    def backend(self) -> str:
        return "c" if self._library is not None else "vm"

    def run(self, state: F64, constants: F64, samples: F64) -> F64:
        """Advance `state` in place over all samples.

        Args:
            state: shape (ns,), changed in place.
            constants: shape (nc,).
            samples: shape (n, ni), C-contiguous.

        Returns:
            outputs, shape (n, no).

        Raises:
            ValueError: wrong shape, dtype or memory layout.
        """
        self._check(state, (self._n_state,), "state")
        self._check(constants, (self._n_constants,), "constants")
        n = samples.shape[0]
        self._check(samples, (n, self._n_sample), "samples")
        outputs = np.empty((n, self._n_output))
        if self._library is not None:
            failed = self._call(n, *map(_address, (state, constants, samples, outputs)))
            if failed:
                raise RuntimeError("the compiled step reported an error")
        else:
            self._run_vm(state, constants, samples, outputs)
        return outputs

    def run_many(self, states: F64, constants: F64, samples: F64) -> F64:
        """Advance many states in place, each over samples of its own: the numbers that `run` gives for each, without
        a call for each, on all cores that this process may use (the interpreter is not held meanwhile).

        Args:
            states: shape (k, ns), C-contiguous, changed in place.
            constants: shape (nc,).
            samples: shape (k, n, ni), C-contiguous.

        Returns:
            outputs, shape (k, n, no).

        Raises:
            ValueError: wrong shape, dtype or memory layout.
        """
        k, n = samples.shape[:2]
        self._check(states, (k, self._n_state), "states")
        self._check(constants, (self._n_constants,), "constants")
        self._check(samples, (k, n, self._n_sample), "samples")
        outputs = np.empty((k, n, self._n_output))
        if self._library is None:
            for state, rows, shown in zip(states, samples, outputs, strict=True):
                self._run_vm(state, constants, rows, shown)
            return outputs

        def part(runs: slice) -> int:
            arrays = (states[runs], constants, samples[runs], outputs[runs])
            return int(self._call_many(len(arrays[0]), n, *map(_address, arrays)))

        threads = min(cores(), k) if k * n >= _WORTH_A_THREAD else 1
        edges = np.linspace(0, k, threads + 1).astype(int).tolist()
        parts = [slice(a, b) for a, b in pairwise(edges)]
        if any(on_all_cores(part, parts)):
            raise RuntimeError("the compiled step reported an error")
        return outputs

    def _run_vm(self, state: F64, constants: F64, samples: F64, outputs: F64) -> None:
        """Blocks of powers of two: a handful of mapped functions serves every length."""
        start, n = 0, samples.shape[0]
        while start < n:
            size = min(self._LARGEST, 1 << ((n - start).bit_length() - 1))
            if size not in self._machines:
                self._machines[size] = _MachineBlock(self._function, size)
            self._machines[size].run(state, constants, samples[start : start + size], outputs[start : start + size])
            start += size

    @staticmethod
    def _check(array: F64, shape: tuple[int, ...], name: str) -> None:
        if array.shape != shape or array.dtype != np.float64 or not array.flags.c_contiguous:
            raise ValueError(f"{name}: need float64 {shape}, C-contiguous; got {array.dtype} {array.shape}")


class _MachineBlock:
    """`size` steps in CasADi's virtual machine through zero-copy buffers.

    The constants ride along in the accumulated state, so that they need not be repeated for every sample.
    """

    def __init__(self, function: ca.Function, size: int) -> None:
        ns, nc = function.numel_in(0), function.numel_in(1)
        carried, sample = ca.SX.sym("carried", ns + nc), ca.SX.sym("sample", function.numel_in(2))
        next_state, output = function(carried[:ns], carried[ns:], sample)
        carrier = ca.Function("carrier", [carried, sample], [ca.vertcat(next_state, carried[ns:]), output])
        # A map of accumulations keeps every state; only the last is wanted: fold by slicing inside one function.
        first, many = ca.MX.sym("first", ns + nc), ca.MX.sym("many", function.numel_in(2), size)
        states, outputs = carrier.mapaccum(size)(first, many)
        self._block = ca.Function("block", [first, many], [states[:, -1], outputs])
        self._ns = ns
        self._carried = np.empty(ns + nc)
        self._last = np.empty(ns + nc)
        self._samples = np.empty((size, function.numel_in(2)))
        self._outputs = np.empty((size, function.numel_out(1)))
        self._buffer, self._trigger = self._block.buffer()
        for k, array in enumerate((self._carried, self._samples)):
            self._buffer.set_arg(k, memoryview(array))  # type: ignore[arg-type, unused-ignore]
        for k, array in enumerate((self._last, self._outputs)):
            self._buffer.set_res(k, memoryview(array))  # type: ignore[arg-type, unused-ignore]

    def run(self, state: F64, constants: F64, samples: F64, outputs: F64) -> None:
        self._carried[: self._ns] = state
        self._carried[self._ns :] = constants
        self._samples[:] = samples
        self._trigger()
        state[:] = self._last[: self._ns]
        outputs[:] = self._outputs
