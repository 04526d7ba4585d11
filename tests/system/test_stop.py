"""A stop is clean and over in two seconds, whatever is going on."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import signal
import socket
import time
from pathlib import Path

import httpx
import pytest

from tests.system.harness import (
    STOP_S,
    Program,
    all_tracking,
    daemon,
    environment,
    nominal_table,
    wait_for,
    write_config,
)

SIGNALS = [signal.SIGTERM, signal.SIGINT]


@pytest.mark.first_is_fast
@pytest.mark.parametrize("number", SIGNALS, ids=lambda n: n.name)
def test_stop_in_the_middle_of_everything(tmp_path: Path, number: signal.Signals) -> None:
    """A drive at work, one whose port is missing, an open stream that is read and one whose client sleeps."""
    config = write_config(
        tmp_path / "c.toml",
        f'name = "axis1"\n{nominal_table()}',
        f'name = "dead"\ndriver = "serial"\n[drive.options]\nport = "{tmp_path / "none"}"',
        f'name = "bus"\ndriver = "can"\n[drive.options]\ninterface = "slcan"\nchannel = "{tmp_path / "none"}"',
    )
    state = tmp_path / "state"
    with daemon("--config", config, "--state-dir", state) as program:
        program.until(all_tracking, "tracks")
        address = httpx.URL(program.url)
        with (
            program.client.stream("GET", "/api/v1/drives/axis1/stream") as stream,
            socket.create_connection((address.host, address.port or 80)) as sleeper,
        ):
            sleeper.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sleeper.sendall(
                f"GET /api/v1/drives/axis1/stream HTTP/1.1\r\nHost: {address.netloc.decode()}\r\n\r\n".encode()
            )
            assert sleeper.recv(12) == b"HTTP/1.1 200"
            lines = stream.iter_lines()
            wait_for(lambda: next(lines).startswith("event: estimates"), "the stream brings estimates")
            took = program.stop(number)
            for _ in lines:  # what was on its way; then the stream ends by itself
                pass
        assert took < STOP_S, program.log
        assert program.said(f"{number.name}: stopping") == 1
        assert (state / "axis1.state.json").is_file(), "what was learned is kept"
        assert not list(state.glob("*.tmp"))


def test_a_stop_does_not_wait_for_what_is_computed(tmp_path: Path) -> None:
    """Six different asks, each of which takes seconds: one is computed, four wait, one is told to come again."""
    with daemon("--config", write_config(tmp_path / "c.toml", nominal_table()), "--state-dir", tmp_path) as program:
        program.until(all_tracking, "tracks")
        address = httpx.URL(program.url)
        with contextlib.ExitStack() as stack:
            lines = [
                stack.enter_context(socket.create_connection((address.host, address.port or 80))) for _ in range(6)
            ]
            for k, line in enumerate(lines):
                path = f"/api/v1/drives/axis1/tuning?bandwidth_hz={1 + k}"
                line.sendall(f"GET {path} HTTP/1.1\r\nHost: a\r\n\r\n".encode())
            refused = wait_for(lambda: select.select(lines, [], [], 0)[0], "one is told to come again")
            assert b" 503 " in refused[0].recv(4096)
            assert program.stop() < STOP_S, program.log


@pytest.mark.first_is_fast
@pytest.mark.parametrize("number", SIGNALS, ids=lambda n: n.name)
def test_stop_during_start_up(tmp_path: Path, number: signal.Signals) -> None:
    """The configuration is a pipe: once it can be opened for writing, the program is waiting for it to be written."""
    pipe = tmp_path / "config"
    os.mkfifo(pipe)
    program = Program("run", "--port", "0", "--config", pipe)

    def reads_it() -> int:
        try:
            return os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            assert error.errno == errno.ENXIO  # nobody reads yet
            return 0

    try:
        writer = wait_for(reads_it, "it opens its configuration")
        # Between opening and reading CPython cannot be woken by a signal: it must be in the system call.
        wchan = Path(f"/proc/{program.process.pid}/wchan")
        wait_for(lambda: wchan.read_text() in ("0", "") or "pipe_read" in wchan.read_text(), "it reads")
        began = time.monotonic()
        program.send(number)
        code = program.wait()
        os.close(writer)
        assert code == 0, program.log
        assert time.monotonic() - began < STOP_S
        assert program.said(f"{number.name} during start-up: stopped") == 1
        assert len(program.log) == 1
    finally:
        program.end()


def test_stop_while_the_model_is_being_compiled(tmp_path: Path) -> None:
    """With an empty cache the first samples meet the C compiler, here one that is slow; nobody waits for it."""
    compiler, at_work = tmp_path / "cc", tmp_path / "at work"
    compiler.write_text(f'#!/bin/sh\n[ "$1" = --version ] && exit\ntouch "{at_work}"\nexec sleep 5\n')
    compiler.chmod(0o700)
    env = environment(XDG_CACHE_HOME=str(tmp_path / "cache"), SERVO_DAEMON_CC=str(compiler))
    config = write_config(tmp_path / "c.toml", nominal_table())
    with daemon("--config", config, "--state-dir", tmp_path / "state", env=env) as program:
        wait_for(at_work.exists, "it compiles")
        assert program.stop() < STOP_S, program.log


def test_a_second_signal_changes_nothing() -> None:
    with daemon() as program:
        program.send(signal.SIGTERM)
        wait_for(lambda: program.said("stopping") or program.process.poll() is not None, "it has heard")
        if program.process.poll() is None:
            program.send(signal.SIGINT)
        assert program.wait() in (0, -signal.SIGINT)  # the latter when it met an interpreter that was already ending
        assert program.said("stopping") == 1
        assert program.said("stopped") == 1


def test_a_simulated_drive_stops_too(tmp_path: Path) -> None:
    for wire in ("serial", "slcan"):
        link = tmp_path / wire
        program = Program("sim-drive", f"--{wire}", link)
        try:
            wait_for(link.exists, "the link")
            began = time.monotonic()
            program.send(signal.SIGTERM)
            assert program.wait() == 0
            assert time.monotonic() - began < STOP_S
            assert not link.is_symlink(), "its link is gone"
        finally:
            program.end()


def test_nohup_outlives_the_terminal() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a child inherits it, as from nohup
    try:
        with daemon() as program:
            program.send(signal.SIGHUP)
            assert program.stop() < STOP_S, program.log
            assert program.said("SIGHUP") == 0 and program.said("SIGTERM: stopping") == 1
    finally:
        signal.signal(signal.SIGHUP, before)
