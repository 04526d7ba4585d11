"""`servo-daemon run`: the daemon with its API and page."""

from __future__ import annotations

import argparse
import asyncio
import errno
import faulthandler
import gc
import logging
import os
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.exposure import check_exposure, follow_certificate, known_tokens
from servo_daemon.config import Config, DriveConfig, load_config
from servo_daemon.errors import ServoDaemonError

if TYPE_CHECKING:
    from servo_daemon.daemon.daemon import Daemon

log = logging.getLogger(__name__)

HELP = "the daemon: estimates, REST API and dashboard; without a config, of a simulated ageing motor"
EXAMPLE = """  servo-daemon run
  servo-daemon run --config /etc/servo-daemon/servo-daemon.toml"""

#: Open streams and slow clients may hold up a stop this long, s.
_DRAIN_S = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_config(parser, drive=False)
    parser.add_argument("--host", help="where the API listens (overrides the config)")
    parser.add_argument("--port", type=int, help="0: any free port, logged at start (overrides the config)")
    parser.add_argument("--state-dir", type=Path, metavar="DIR", help="where estimates are kept over a restart")


def run(arguments: argparse.Namespace) -> int:
    faulthandler.enable()  # systemd's watchdog ends a hung daemon with SIGABRT: the journal then shows every stack
    try:
        with _stop_during_start_up():
            from servo_daemon.daemon.daemon import Daemon
            from servo_daemon.daemon.state_lock import state_locked

            config = _configuration(arguments)
            state_dir = _state_dir(arguments, config)
            listener = _listen(config.api.host, config.api.port)
            check_exposure(listener.getsockname()[0], config.api)
            with listener, state_locked(state_dir, (d.name for d in config.drive)):
                daemon = Daemon(config, state_dir)
                with asyncio.Runner(loop_factory=_loop_factory()) as runner:
                    runner.run(_serve(daemon, listener))
    except _StopError as stop:
        log.info("%s during start-up: stopped", stop)
    return 0


class _StopError(BaseException):
    """A stop before the daemon runs: nothing is open yet that would have to be closed in order."""


@contextmanager
def _stop_during_start_up() -> Iterator[None]:
    """Importing CasADi and compiling a new model take seconds, in which a stop must be as clean as later."""

    def stop(number: int, _frame: FrameType | None) -> None:
        raise _StopError(signal.Signals(number).name)

    previous = {number: signal.signal(number, stop) for number in common.stop_signals()}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def demo_drive() -> DriveConfig:
    """The simulated ageing motor of `run` without a config, its nominal values a good third off."""
    from servo_daemon.simulate import DEFAULT_AGEING, DEFAULT_J_M, DEFAULT_NOMINAL

    ageing = {name: list(texts) for name, texts in DEFAULT_AGEING.items()}
    return DriveConfig(nominal=dict(DEFAULT_NOMINAL), options={"J_m": DEFAULT_J_M, "ageing": ageing})


def _configuration(arguments: argparse.Namespace) -> Config:
    """The config file with environment and flags on top."""
    config = load_config(arguments.config)
    if arguments.config is None:
        config = config.model_copy(update={"drive": (demo_drive(),)})
    flags = {k: getattr(arguments, k) for k in ("host", "port") if getattr(arguments, k) is not None}
    if flags:
        from servo_daemon.config import parse_config

        api = parse_config({"api": config.api.model_dump() | flags}, "command line").api
        config = config.model_copy(update={"api": api})
    return config


def _state_dir(arguments: argparse.Namespace, config: Config) -> Path | None:
    """Flag, config, systemd's STATE_DIRECTORY, the user's own; nothing is kept of the motor of the demonstration."""
    if arguments.state_dir is not None:
        return Path(arguments.state_dir)
    if config.storage.state_dir is not None:
        return Path(config.storage.state_dir)
    if "STATE_DIRECTORY" in os.environ:
        return Path(os.environ["STATE_DIRECTORY"].split(":")[0])
    if arguments.config is None:
        return None
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(base) / "servo-daemon"


def _listen(host: str, port: int) -> socket.socket:
    """The API's socket, bound before anything else starts.

    Raises:
        ServoDaemonError: the address is taken or not ours.
    """
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[
            0
        ]
        # asyncio switches Nagle's algorithm off only where it sees the protocol named; else an answer takes 40 ms.
        listener = socket.socket(family, kind, socket.IPPROTO_TCP)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(128)
        except BaseException:
            listener.close()
            raise
        return listener
    except OSError as error:
        reason = error.strerror or str(error)
        taken = error.errno == errno.EADDRINUSE
        hint = "; is another servo-daemon running? --port 0 takes any free one" if taken else ""
        raise ServoDaemonError(f"cannot listen on {host} port {port}: {reason}{hint}") from error


def _loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """uvloop where there is one: a third of the cost of a request; None for asyncio's own."""
    try:
        import uvloop
    except ImportError:
        return None
    factory: Callable[[], asyncio.AbstractEventLoop] = uvloop.new_event_loop
    return factory


async def _serve(daemon: Daemon, listener: socket.socket) -> None:
    """API in this thread's event loop, everything else in threads of the daemon, until a signal says stop."""
    loop, told = asyncio.get_running_loop(), asyncio.Event()

    def stop(name: str) -> None:
        if not told.is_set():
            log.info("%s: stopping", name)
            told.set()
            daemon.begin_stop()

    for number in common.stop_signals():
        loop.add_signal_handler(number, stop, number.name)
    daemon.start()
    try:
        await _serve_api(daemon, listener, told)
    finally:
        daemon.stop()
    log.info("stopped")


async def _serve_api(daemon: Daemon, listener: socket.socket, told: asyncio.Event) -> None:
    """Answer requests until told to stop."""
    # Imported while the drives are already being read: half of the time to the first estimate.
    import uvicorn

    from servo_daemon.api.access.connections import MOST_CONNECTIONS, ConnectionTable, bounded_protocol
    from servo_daemon.api.app import create_app
    from servo_daemon.api.computing import ProcessComputer
    from servo_daemon.daemon.descriptors import room_for_connections

    class Server(uvicorn.Server):
        @contextmanager
        def capture_signals(self) -> Iterator[None]:  # the daemon's own handlers stay in charge
            yield

    table = ConnectionTable(room_for_connections(len(daemon.drives), MOST_CONNECTIONS))
    settings: dict[str, Any] = {
        "http": bounded_protocol(table),
        "ws": "none",
        "proxy_headers": False,
        "server_header": False,
        "log_level": "warning",
        "access_log": False,
        "timeout_graceful_shutdown": _DRAIN_S,
    }
    api, computer = daemon.config.api, ProcessComputer()
    if api.certificate is not None:
        settings |= {"ssl_certfile": api.certificate, "ssl_keyfile": api.private_key}
    app = create_app(daemon, api.allowed_hosts, computer, known_tokens(api), api.metrics == "open")
    server = Server(uvicorn.Config(app, **settings))

    async def exit_when_told() -> None:
        await told.wait()
        computer.close()
        server.should_exit = True

    watchers = [asyncio.create_task(w) for w in (exit_when_told(), follow_certificate(server.config, api))]
    # What is loaded now stays: the garbage collector need not walk through it again and again.
    gc.collect()
    gc.freeze()
    host, port = listener.getsockname()[:2]
    scheme = "http" if api.certificate is None else "https"
    log.info("API and dashboard on %s://%s:%s/", scheme, f"[{host}]" if ":" in host else host, port)
    await server.serve(sockets=[listener])
    for watcher in watchers:
        watcher.cancel()
