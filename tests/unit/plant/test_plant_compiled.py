"""The sample loop: C and virtual machine give the same bits, blocks do not matter, and what fails falls back."""

from __future__ import annotations

import logging
import multiprocessing
import stat
import subprocess
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from servo_daemon.plant import at_once, compiled, compiler
from servo_daemon.plant.build import build_plant
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.plant.compiler import find_compiler, split
from servo_daemon.samples import F64
from tests.twin import reference_step

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler on this machine")
ALL = ("coulomb_friction", "constant_load_torque", "gravity_load", "winding_heating")


def step_function(effects: tuple[str, ...], gain: float = 1.0) -> ca.Function:
    model = build_plant(effects)
    x, p = ca.SX.sym("x", len(model.states)), ca.SX.sym("p", len(model.parameters))
    row = ca.SX.sym("row", 3)
    return ca.Function("step", [x, p, row], [model.step(x, gain * row[2], p, row[0], row[1]), x])


def inputs(effects: tuple[str, ...], n: int) -> tuple[F64, F64, F64]:
    model, rng = build_plant(effects), np.random.default_rng(3)
    h = 1e-3 * rng.uniform(0.5, 1.5, n)
    rows = np.column_stack([np.cumsum(h), h, 8 * rng.standard_normal(n)])
    return np.zeros(len(model.states)), np.array([p.nominal for p in model.parameters]), rows


@pytest.fixture(scope="module")
def shared_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Code that is compiled here, once for all tests that do not look at how."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def _cache(shared_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    monkeypatch.delenv("SERVO_DAEMON_CC", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(shared_cache))


@pytest.fixture
def own_cache(_cache: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "servo-daemon"


@needs_compiler
def test_what_is_prepared_once_a_length_gives_the_same_bits() -> None:
    effects = ("coulomb_friction",)
    x, p, rows = inputs(effects, 10_000)
    plain, paced = SampleLoop(step_function(effects)), SampleLoop(step_function(effects), paced_by=1)
    few = rows.copy()
    few[:, 1] = rows[np.random.default_rng(4).integers(0, 300, len(rows)), 1]
    few[[5, 6], 1] = 0.0, -0.0
    few[-1, 1] = np.frombuffer(b"\xff" * 8)[0]  # the length whose key would be that of an empty place
    for case in (rows, few):  # more lengths than a call's table has places for, and fewer
        one, other = x.copy(), x.copy()
        np.testing.assert_array_equal(plain.run(one, p, case), paced.run(other, p, case))
        np.testing.assert_array_equal(one, other)


@needs_compiler
def test_a_function_of_the_same_argument_as_before_is_known_by_its_bits() -> None:
    """0 is no −0 to a sine, and not a number is none."""
    x, p, row = ca.SX.sym("x"), ca.SX.sym("p"), ca.SX.sym("row", 2)
    step = ca.Function("step", [x, p, row], [x, ca.vertcat(ca.sin(row[0]), ca.atan2(row[0], row[1]))])
    at = np.frombuffer(b"\xff" * 8)[0]
    rows = np.array(
        [[at, at], [0.0, -1.0], [-0.0, -1.0], [-0.0, 1.0], [np.nan, 1.0], [2.0, 1.0], [2.0, 1.0], [2.0, 3.0]]
    )
    out = SampleLoop(step).run(np.zeros(1), np.zeros(1), rows)
    wanted = np.stack([np.sin(rows[:, 0]), np.arctan2(rows[:, 0], rows[:, 1])], axis=1)
    np.testing.assert_allclose(out, wanted, rtol=1e-15)
    np.testing.assert_array_equal(np.signbit(out[1:4]), np.signbit(wanted[1:4]))


def test_only_what_depends_on_the_motion_is_left_to_every_sample() -> None:
    function = step_function(())
    prepare, rest = split(function, 1)
    assert prepare is not None
    assert rest.n_instructions() < 0.2 * function.n_instructions()
    by_the_heat = step_function(("winding_heating",))  # R follows the winding's temperature
    assert split(by_the_heat, 1) == (None, by_the_heat)


@needs_compiler
@pytest.mark.parametrize("effects", [(), ("coulomb_friction",), ("winding_heating",), ("backlash",), ALL], ids="+".join)
def test_c_and_machine_give_the_same_bits(effects: tuple[str, ...]) -> None:
    x, p, rows = inputs(effects, 3000)
    in_c, in_vm = SampleLoop(step_function(effects)), SampleLoop(step_function(effects), compiled=False)
    assert (in_c.backend, in_vm.backend) == ("c", "vm")
    other = x.copy()
    np.testing.assert_array_equal(in_c.run(x, p, rows), in_vm.run(other, p, rows))
    np.testing.assert_array_equal(x, other)
    assert np.ptp(x) > 0


def test_a_block_agrees_with_the_twin() -> None:
    x, p, rows = inputs(ALL, 40)
    twin, model = x.copy(), build_plant(ALL)
    SampleLoop(step_function(ALL)).run(x, p, rows)
    for t, h, u in rows:
        twin = reference_step(model, twin, u, p, t, h)
    np.testing.assert_allclose(x, twin, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("use_c", [pytest.param(True, marks=needs_compiler), False], ids=["c", "vm"])
@pytest.mark.parametrize("size", [1, 7, 64, 300, 700])
def test_blocks_do_not_matter(use_c: bool, size: int) -> None:
    loop = SampleLoop(step_function(ALL), compiled=use_c)
    x, p, rows = inputs(ALL, 700)
    whole = loop.run(x.copy(), p, rows)
    parts = [loop.run(x, p, np.ascontiguousarray(rows[k : k + size])) for k in range(0, 700, size)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def many(k: int, n: int, effects: tuple[str, ...] = ALL) -> tuple[F64, F64, F64]:
    """k runs of n samples, each from a state and with inputs of its own."""
    x, p, rows = inputs(effects, k * n)
    return np.outer(np.arange(k), np.ones(len(x))) * 1e-3, p, rows.reshape(k, n, 3)


@pytest.mark.parametrize("use_c", [pytest.param(True, marks=needs_compiler), False], ids=["c", "vm"])
@pytest.mark.parametrize(("k", "n"), [(1, 40), (7, 30), (5, 1800)], ids=["one", "few", "threads"])
def test_many_runs_are_each_what_it_is_alone(use_c: bool, k: int, n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "cores", lambda: 3)
    loop = SampleLoop(step_function(ALL), compiled=use_c, side_by_side=True)
    states, p, rows = many(k, n)
    alone = states.copy()
    outputs = loop.run_many(states, p, rows)
    assert outputs.shape == (k, n, len(states[0]))
    for state, samples, shown in zip(alone, rows, outputs, strict=True):
        np.testing.assert_array_equal(loop.run(state, p, samples), shown)
    np.testing.assert_array_equal(states, alone)


@pytest.mark.parametrize("use_c", [pytest.param(True, marks=needs_compiler), False], ids=["c", "vm"])
def test_no_run_at_all_is_none(use_c: bool) -> None:
    states, p, rows = many(2, 5)
    loop = SampleLoop(step_function(ALL), compiled=use_c)
    assert loop.run_many(states[:0], p, rows[:0]).shape == (0, 5, states.shape[1])


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda x, p, rows: (x[:-1], p, rows), "states"),
        (lambda x, p, rows: (x, p[:-1], rows), "constants"),
        (lambda x, p, rows: (x, p, rows[:, ::2]), "samples"),
    ],
    ids=["states", "constants", "samples"],
)
def test_many_wrong_arrays_are_refused(change: Callable[..., tuple[F64, F64, F64]], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        SampleLoop(step_function(ALL)).run_many(*change(*many(3, 6)))


def test_no_argument_and_no_result_is_asked_whether_it_is_there() -> None:
    source = compiler._generate(step_function(("coulomb_friction",)), 1, True)
    assert "arg[0][0];" in source and "res[0][0]=" in source and "sd_given0[0];" in source
    assert "]? arg[" not in source and "]!=0) res[" not in source


@pytest.mark.parametrize("wanted", [True, False])
@pytest.mark.parametrize("effect", ["backlash", "magnetic_saturation", "stribeck_friction"])
def test_code_is_rewritten_for_runs_side_by_side(effect: str, wanted: bool) -> None:
    assert ("sd_step_lanes(const" in compiler._generate(step_function((effect,)), None, wanted)) == wanted


@needs_compiler
def test_without_code_for_runs_side_by_side_the_numbers_are_the_same() -> None:
    function, (states, p, rows) = step_function(("coulomb_friction",)), many(6, 30, ("coulomb_friction",))
    loops = SampleLoop(function), SampleLoop(function, side_by_side=True)
    one, other = (loop.run_many(states.copy(), p, rows) for loop in loops)
    np.testing.assert_array_equal(one, other)


@needs_compiler
def test_runs_side_by_side_with_constants_of_their_own_are_what_each_is_alone() -> None:
    effects = ("coulomb_friction",)
    function = step_function(effects)
    rng, (x, p, rows) = np.random.default_rng(3), inputs(effects, 40)
    states, own = np.tile(x, (6, 1)), p * rng.uniform(0.8, 1.2, (6, len(p)))
    states[:, : len(x)] += rng.normal(size=states.shape) * 0.1
    alone, loop = states.copy(), SampleLoop(function, paced_by=1, side_by_side=True)
    shown = loop.run_many(states, own, np.tile(rows, (6, 1, 1)))
    assert len(np.unique(shown[:, -1, 0])) == 6
    for state, constants, seen in zip(alone, own, shown, strict=True):
        np.testing.assert_array_equal(loop.run(state, constants.copy(), rows), seen)
    np.testing.assert_array_equal(states, alone)


@needs_compiler
def test_zeros_of_either_sign_and_no_numbers_side_by_side() -> None:
    x, y, row = ca.SX.sym("x"), ca.SX.sym("y"), ca.SX.sym("row", 2)
    a, b = row[0], row[1]
    choices = [
        ca.fmax(a, b),
        ca.fmin(a, b),
        ca.if_else(a < b, a, b),
        ca.if_else(ca.logic_or(a == b, a * 0 != 0), x, -b),
    ]
    shown = ca.vertcat(
        *choices, ca.fabs(a), ca.sign(a), ca.sqrt(a), ca.exp(b), ca.atan2(a, b), ca.logic_not(a), 2 * a - b / a
    )
    loop = SampleLoop(ca.Function("step", [x, y, row], [x + y, shown]), side_by_side=True)
    odd = np.array([0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 5e-324])
    rows = np.ascontiguousarray(np.stack(np.meshgrid(odd, odd), axis=-1))
    many = loop.run_many(np.ones((8, 1)), np.array([1.0]), rows)
    for samples, seen in zip(rows, many, strict=True):
        one = loop.run(np.ones(1), np.array([1.0]), samples)
        np.testing.assert_array_equal(one, seen)
        signed = ~np.isnan(one[:, 2:])  # which of two zeros is the larger the compiler chooses
        np.testing.assert_array_equal(np.signbit(one[:, 2:][signed]), np.signbit(seen[:, 2:][signed]))


def test_code_with_an_unknown_statement_runs_one_after_the_other() -> None:
    x, p, row = (ca.SX.sym(name) for name in ("x", "p", "row"))
    source = compiler._generate(ca.Function("step", [x, p, row], [x + row, ca.floor(x * p)]), None, True)
    assert "sd_step_lanes(const" not in source


@needs_compiler
def test_a_forked_child_has_threads_of_its_own() -> None:
    """The pool's threads do not come along, and who waits for them waits for ever."""
    loop = SampleLoop(step_function(ALL))
    states, p, rows = many(4, 1000)
    here = loop.run_many(states.copy(), p, rows)
    pool = at_once._pool()
    assert loop.run_many(states.copy(), p, rows).tobytes() == here.tobytes()
    assert at_once._pool() is pool
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as processes:
        there = processes.submit(in_child, states, p, rows).result(timeout=60)
    np.testing.assert_array_equal(there, here)


def in_child(states: F64, p: F64, rows: F64) -> F64:
    return SampleLoop(step_function(ALL)).run_many(states, p, rows)


@pytest.mark.parametrize("use_c", [pytest.param(True, marks=needs_compiler), False], ids=["c", "vm"])
def test_an_empty_block_changes_nothing(use_c: bool) -> None:
    x, p, rows = inputs((), 1)
    assert SampleLoop(step_function(()), compiled=use_c).run(x, p, rows[:0]).shape == (0, 3)
    assert not x.any()


def test_wrong_arrays_are_refused() -> None:
    loop = SampleLoop(step_function(()), compiled=False)
    x, p, rows = inputs((), 4)
    for state, constants, samples, name in [
        (x[:2].copy(), p, rows, "state"),
        (x, p.astype(np.float32), rows, "constants"),
        (x, p, np.asfortranarray(rows), "samples"),
        (x, p, np.ones((4, 2)), "samples"),
    ]:
        with pytest.raises(ValueError, match=name):
            loop.run(state, constants, samples)


def test_the_function_must_be_named_step() -> None:
    z, c, s = (ca.SX.sym(name) for name in "zcs")
    with pytest.raises(ValueError, match="step"):
        SampleLoop(ca.Function("other", [z, c, s], [z, z]))


@needs_compiler
def test_second_time_comes_from_the_cache(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert SampleLoop(step_function(())).backend == "c"
    assert len(list(own_cache.iterdir())) == 1
    assert stat.S_IMODE(own_cache.stat().st_mode) == 0o700

    def no_compiling(command: list[str], **_: object) -> None:
        raise AssertionError(f"compiled again: {command}")

    monkeypatch.setattr(subprocess, "run", no_compiling)
    assert SampleLoop(step_function(())).backend == "c"


@needs_compiler
def test_another_function_is_another_cache_entry(own_cache: Path) -> None:
    SampleLoop(step_function(()))
    SampleLoop(step_function((), gain=1.0000001))
    assert len(list(own_cache.glob("*.so"))) == 2


@needs_compiler
def test_a_damaged_cache_file_is_compiled_again(
    own_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    function = step_function((), gain=2.0)
    SampleLoop(function)
    (library,) = own_cache.iterdir()
    other = tmp_path / "other" / "servo-daemon"  # another path: the loader knows the first one as loaded already
    other.mkdir(parents=True)
    (other / library.name).write_bytes(b"power went away here")
    monkeypatch.setenv("XDG_CACHE_HOME", str(other.parent))
    with caplog.at_level(logging.WARNING):
        assert SampleLoop(function).backend == "c"
    assert "compiling it again" in caplog.text


@needs_compiler
def test_a_cache_that_cannot_be_written_is_replaced_by_a_private_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("not a directory")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    private = tmp_path / "private"
    private.mkdir()
    monkeypatch.setattr(compiler, "_private_temporary", lambda: private)
    assert SampleLoop(step_function(())).backend == "c"
    assert list(private.glob("*.so"))


def test_systemd_cache_directory_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CACHE_DIRECTORY", f"{tmp_path}/a:{tmp_path}/b")
    assert compiler.cache_directory() == tmp_path / "a" / "servo-daemon"


def test_a_broken_compiler_falls_back_with_a_log_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho 'cc1: killed' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("SERVO_DAEMON_CC", str(broken))
    with caplog.at_level(logging.WARNING):
        loop = SampleLoop(step_function(()))
    assert loop.backend == "vm"
    assert "cc1: killed" in caplog.text


@pytest.mark.parametrize("named", ["", "no-such-compiler-anywhere"])
def test_without_a_compiler_the_machine_serves(
    named: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SERVO_DAEMON_CC", named)
    with caplog.at_level(logging.INFO):
        loop = SampleLoop(step_function(()))
    assert loop.backend == "vm"
    assert "no C compiler" in caplog.text
    x, p, rows = inputs((), 5)
    assert np.all(np.isfinite(loop.run(x, p, rows)))
