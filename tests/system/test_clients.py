"""What clients may do to a running daemon: its drive at 1 kHz loses no sample, and its state is still saved."""

from __future__ import annotations

import contextlib
import resource
import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.system.harness import DaemonProgram, all_tracking, daemon, nominal_table, wait_for, write_config

MB = 1024 * 1024
#: Where three times as many clients as the daemon takes can be opened from here.
CLIENTS = 1300


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[DaemonProgram, Path]]:
    folder = tmp_path_factory.mktemp("clients")
    # No learned model: its libraries are imported some time after the start, and take 50 MB.
    drive = nominal_table()
    config = write_config(folder / "c.toml", drive, head="[storage]\nsave_interval_s = 0.5\n")
    state = folder / "state"
    with daemon("--config", config, "--state-dir", state) as program:
        program.until(all_tracking, "tracks")
        yield program, state / "axis1.state.json"


def status_kB(program: DaemonProgram, key: str) -> int:
    lines = Path(f"/proc/{program.process.pid}/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(key))


def assert_nothing_was_lost(program: DaemonProgram, since: int) -> None:
    health = program.until(lambda d: d["health"]["samples"] > since + 1000, "samples go on")["health"]
    assert health["samples_lost"] == 0 and health["queue_dropped"] == 0, health


def post_forever(program: DaemonProgram, head: bytes, part: bytes, most: int) -> tuple[bytes, int]:
    """The first line of the answer, and how many bytes were taken before the connection ended."""
    address = httpx.URL(program.url)
    sent = 0
    with socket.create_connection((address.host, address.port or 80), timeout=30) as line:
        line.sendall(
            b"POST /api/v1/drives/axis1/model HTTP/1.1\r\nHost: a\r\nContent-Type: application/json\r\n" + head
        )
        with contextlib.suppress(OSError):
            while sent < most:
                line.sendall(part)
                sent += len(part)
        with contextlib.suppress(OSError):
            return line.recv(4096).partition(b"\r\n")[0], sent
    return b"", sent


def test_a_body_of_60_MB_costs_neither_samples_nor_memory(running: tuple[DaemonProgram, Path]) -> None:
    program, _ = running
    since = program.estimates()["health"]["samples"]
    before = status_kB(program, "VmHWM")
    part = b"[" * MB
    line, sent = post_forever(program, b"Content-Length: 62914560\r\n\r\n", part, 60 * MB)
    assert line in (b"HTTP/1.1 413 Request Entity Too Large", b"HTTP/1.1 413 Content Too Large"), line
    assert sent < 10 * MB, "what the kernel's buffers took"
    chunk = b"%x\r\n%b\r\n" % (MB, part)
    assert post_forever(program, b"Transfer-Encoding: chunked\r\n\r\n", chunk, 60 * MB)[1] < 10 * MB
    assert_nothing_was_lost(program, since)
    assert status_kB(program, "VmHWM") - before < 30 * 1024, "half of what was sent; the pipeline itself takes some"


@pytest.mark.slow
def test_idle_clients_leave_descriptors_for_the_state(running: tuple[DaemonProgram, Path]) -> None:
    program, state = running
    wait_for(state.exists, "the state is saved for the first time")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, CLIENTS + 200)), hard))
    address = httpx.URL(program.url)
    since = program.estimates()["health"]["samples"]
    with contextlib.ExitStack() as stack:
        for k in range(CLIENTS):
            line = stack.enter_context(socket.create_connection((address.host, address.port or 80), timeout=30))
            if k % 2:
                line.sendall(b"GET /api/v1/health HTTP/1.1\r\nX-Slow: ")
        saved = state.stat().st_mtime_ns
        wait_for(lambda: state.stat().st_mtime_ns > saved, "the state is saved")
        assert len(list(Path(f"/proc/{program.process.pid}/fd").iterdir())) < 400
        # The first clients' time is up, so there is room again although none of them has gone.
        wait_for(lambda: _answers(program.url), "others are answered")
    assert program.said("connections refused") == 1
    assert_nothing_was_lost(program, since)


def _answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/api/v1/health", trust_env=False).status_code == 200
    except httpx.TransportError:
        return False
