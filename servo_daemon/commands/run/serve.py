"""API in one event loop, everything else in threads of the daemon, until a signal says stop."""

from __future__ import annotations

import asyncio
import gc
import logging
import signal
import socket
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from servo_daemon.commands.run.reload import Files, Reload
from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.exposure import ServedCertificate, certificate_files, known_tokens

if TYPE_CHECKING:
    from pathlib import Path

    import uvicorn
    from fastapi import FastAPI

    from servo_daemon.api.access.connections import ConnectionTable
    from servo_daemon.daemon.daemon import Daemon

log = logging.getLogger(__name__)

#: A thread that computes lets another on after so long, s. An answer from the history lets go of the interpreter some
#: hundred times, and may wait so long each time: with Python's own 5 ms it took 60 ms more beside a thread that never
#: rests, with this 25 ms; what threads get done in a second of CPU was the same to 2 %.
SWITCH_S: Final = 5e-4
#: Open streams and slow clients may hold up a stop this long, s.
_DRAIN_S = 1


async def serve(daemon: Daemon, listener: socket.socket, files: Files, hangups: Sequence[int]) -> None:
    """Start the daemon and answer until told to stop.

    Args:
        files: of the configuration.
        hangups: SIGHUPs that have come during the start.
    """
    loop, told, hung_up = asyncio.get_running_loop(), asyncio.Event(), asyncio.Event()

    def stop(name: str) -> None:
        if not told.is_set():
            log.info("%s: stopping", name)
            told.set()
            daemon.begin_stop()

    for number in common.stop_signals():
        loop.add_signal_handler(number, stop, number.name)
    if not common.has_terminal():
        loop.add_signal_handler(signal.SIGHUP, hung_up.set)
    if hangups:
        hung_up.set()
    sys.setswitchinterval(SWITCH_S)
    daemon.start()
    try:
        await _serve_api(daemon, listener, told, hung_up, files)
    finally:
        daemon.stop()
    log.info("stopped")


async def _serve_api(
    daemon: Daemon,
    listener: socket.socket,
    told: asyncio.Event,
    hung_up: asyncio.Event,
    files: Files,
) -> None:
    """Answer requests until told to stop."""
    # Imported while the drives are already being read: half of the time to the first estimate.
    from servo_daemon.api.access.connections import MOST_CONNECTIONS, ConnectionTable
    from servo_daemon.api.access.permission import Access
    from servo_daemon.api.app import create_app
    from servo_daemon.api.computing import ProcessComputer
    from servo_daemon.daemon.descriptors import room_for_connections

    table = ConnectionTable(room_for_connections(len(daemon.drives), MOST_CONNECTIONS))
    api, computer = daemon.config.api, ProcessComputer()
    pair = certificate_files(api)
    access = Access(known_tokens(api), api.metrics == "open", api.allowed_hosts)
    server = _server(create_app(daemon, access, computer), table, pair)
    tls = server.config.ssl
    certificate = None if pair is None or tls is None else ServedCertificate(tls, pair)
    host, port = listener.getsockname()[:2]

    async def exit_when_told() -> None:
        await told.wait()
        computer.close()
        server.should_exit = True

    reload = Reload(daemon, files, host, access, certificate)
    watchers = [asyncio.create_task(w) for w in (exit_when_told(), reload.follow(hung_up))]
    if certificate is not None:
        watchers.append(asyncio.create_task(certificate.follow()))
    # What is loaded now stays: the garbage collector need not walk through it again and again.
    gc.collect()
    gc.freeze()
    scheme = "http" if pair is None else "https"
    log.info("API and dashboard on %s://%s:%s/", scheme, f"[{host}]" if ":" in host else host, port)
    await server.serve(sockets=[listener])
    for watcher in watchers:
        watcher.cancel()


def _server(app: FastAPI, table: ConnectionTable, pair: tuple[Path, Path] | None) -> uvicorn.Server:
    """uvicorn with the connections bounded.

    Args:
        pair: certificate and private key; None: no TLS.
    """
    import uvicorn

    from servo_daemon.api.access.connections import bounded_protocol

    class Server(uvicorn.Server):
        @contextmanager
        def capture_signals(self) -> Iterator[None]:  # the daemon's own handlers stay in charge
            yield

    settings: dict[str, Any] = {
        "http": bounded_protocol(table),
        "ws": "none",
        "proxy_headers": False,
        "server_header": False,
        "log_level": "warning",
        "access_log": False,
        "timeout_graceful_shutdown": _DRAIN_S,
    }
    if pair is not None:
        settings |= {"ssl_certfile": str(pair[0]), "ssl_keyfile": str(pair[1])}
    config = uvicorn.Config(app, **settings)
    config.load()
    return Server(config)
