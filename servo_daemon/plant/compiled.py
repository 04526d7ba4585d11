"""The one wrapper that owns CasADi buffers: runs a step function over a block of samples, in C where a compiler exists.

A `SampleLoop` takes a CasADi function `(state, constants, sample) -> (state, output)` and runs it over an array of
samples without returning to Python. With a C compiler on the machine the function's generated C code is compiled once
and cached by content hash; without one CasADi's virtual machine runs the same expressions. Both do the same operations
in the same order (`-ffp-contract=off`, no fast-math), so the numbers are the same either way, and any partition of the
samples into blocks gives bit-identical results.
"""

from __future__ import annotations

import ctypes
import logging
import subprocess
from itertools import pairwise

import casadi as ca
import numpy as np

from servo_daemon.plant.at_once import cores, on_all_cores
from servo_daemon.plant.c_code.lanes import LANES
from servo_daemon.plant.compiler import compile_step, find_compiler
from servo_daemon.samples import F64

log = logging.getLogger(__name__)

#: Samples that there is room for from the start: a tick at 2 kHz.
_ROOM = 200
#: Runs of fewer samples in all are not worth a second thread: 40 to 500 ns each, and to hand them over takes 100 µs.
_WORTH_A_THREAD = 8_000


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
        paced_by: which element of the sample is the length of the step, where it has one. What follows from it and the
            constants alone, an exponential of the motor for one, is computed once for every length that occurs in a
            call: the same operations, so the same numbers.
        side_by_side: whether `run_many` is worth code of its own, which computes four runs at once.

    Attributes:
        backend: "c" or "vm".
    """

    _LARGEST = 256  # samples a single VM call takes; longer blocks are split

    def __init__(
        self, function: ca.Function, *, compiled: bool = True, paced_by: int | None = None, side_by_side: bool = False
    ) -> None:
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
                self._library = compile_step(function, compiler, paced_by, side_by_side)
                self._call = self._library.servo_daemon_loop
                self._call.restype = ctypes.c_int
                self._call.argtypes = [ctypes.c_longlong] + [ctypes.c_void_p] * 4
                self._call_many = self._library.servo_daemon_loops
                self._call_many.restype = ctypes.c_int
                self._call_many.argtypes = [ctypes.c_longlong] * 2 + [
                    *[ctypes.c_void_p] * 2,
                    ctypes.c_longlong,
                    *[ctypes.c_void_p] * 2,
                ]
            except (OSError, subprocess.SubprocessError) as error:
                detail = getattr(error, "stderr", "") or ""
                log.warning("C compilation failed (%s %s): using CasADi's virtual machine", error, detail.strip())
                self._library = None
        elif compiled:
            log.info("no C compiler found: using CasADi's virtual machine (about 5 x slower, same numbers)")
        self._machines: dict[int, _MachineBlock] = {}
        self._known: tuple[F64, F64, int, int] | None = None  # state and constants of the last call, and where they are
        self._make_room(_ROOM)

    @property
    def backend(self) -> str:
        return "c" if self._library is not None else "vm"

    def _make_room(self, n: int) -> None:
        self._room = np.ones((n, self._n_sample))
        self._room_at = _address(self._room)

    def room(self, n: int) -> F64:
        """Where the samples of the next `run` may be laid out, shape (n, ni): ones, or what was left there."""
        if n > len(self._room):
            self._make_room(2 * n)
        return self._room[:n]

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
        known = self._known
        if known is None or known[0] is not state or known[1] is not constants:
            self._check(state, (self._n_state,), "state")
            self._check(constants, (self._n_constants,), "constants")
            self._known = known = state, constants, _address(state), _address(constants)
        n = samples.shape[0]
        own = samples.base is self._room
        if not own:
            self._check(samples, (n, self._n_sample), "samples")
        outputs = np.empty((n, self._n_output))
        if self._library is not None:
            at = self._room_at if own else _address(samples)
            failed = self._call(n, known[2], known[3], at, _address(outputs))
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
            constants: shape (nc,), or (k, nc): each run's own.
            samples: shape (k, n, ni), C-contiguous.

        Returns:
            outputs, shape (k, n, no).

        Raises:
            ValueError: wrong shape, dtype or memory layout.
        """
        k, n = samples.shape[:2]
        self._check(states, (k, self._n_state), "states")
        own = constants.ndim == 2
        self._check(constants, (k, self._n_constants) if own else (self._n_constants,), "constants")
        self._check(samples, (k, n, self._n_sample), "samples")
        outputs = np.empty((k, n, self._n_output))
        if self._library is None:
            for run, (state, rows, shown) in enumerate(zip(states, samples, outputs, strict=True)):
                self._run_vm(state, constants[run] if own else constants, rows, shown)
            return outputs

        def part(runs: slice) -> int:
            first = _address(constants[runs] if own else constants), self._n_constants if own else 0
            state, sample, shown = (_address(array[runs]) for array in (states, samples, outputs))
            return int(self._call_many(runs.stop - runs.start, n, state, *first, sample, shown))

        threads = min(cores(), k) if k * n >= _WORTH_A_THREAD else 1
        group = LANES if k >= LANES * threads else 1  # of what is simulated at once
        edges = [k * part // threads // group * group for part in range(threads)] + [k]
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
