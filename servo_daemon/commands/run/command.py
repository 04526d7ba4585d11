"""`servo-daemon run`: the daemon with its API and page."""

from __future__ import annotations

import argparse
import asyncio
import faulthandler
import logging
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType

from servo_daemon.commands.run.heap import share_one_heap
from servo_daemon.commands.run.listener import listen
from servo_daemon.commands.shared import common
from servo_daemon.commands.shared.exposure import check_exposure
from servo_daemon.config import Config, DriveConfig, load_config, parse_config

log = logging.getLogger(__name__)

HELP = "the daemon: estimates, REST API and dashboard; without a config, of a simulated ageing motor"
EXAMPLE = """  servo-daemon run
  servo-daemon run --config /etc/servo-daemon/servo-daemon.toml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_config(parser, drive=False)
    parser.add_argument("--host", help="where the API listens (overrides the config)")
    parser.add_argument("--port", type=int, help="0: any free port, logged at start (overrides the config)")
    parser.add_argument("--state-dir", type=Path, metavar="DIR", help="where estimates are kept over a restart")


def run(arguments: argparse.Namespace) -> int:
    faulthandler.enable()  # systemd's watchdog ends a hung daemon with SIGABRT: the journal then shows every stack
    share_one_heap()
    hangups: list[int] = []
    try:
        with _stop_during_start_up(hangups):
            from servo_daemon.commands.run.reload import Files
            from servo_daemon.commands.run.serve import serve
            from servo_daemon.daemon.daemon import Daemon
            from servo_daemon.daemon.state_lock import StateLocks

            config = configuration(arguments)
            follow_log_level(arguments, config)
            state_dir = _state_dir(arguments, config)
            listener = listen(config.api.host, config.api.port)
            check_exposure(listener.getsockname()[0], config.api)
            with listener, StateLocks(state_dir) as locks:
                locks.take(d.name for d in config.drive)
                daemon = Daemon(config, state_dir, locks=locks)
                files = Files(partial(configuration, arguments), partial(follow_log_level, arguments))
                with asyncio.Runner(loop_factory=_loop_factory()) as runner:
                    runner.run(serve(daemon, listener, files, hangups))
    except _StopError as stop:
        log.info("%s during start-up: stopped", stop)
    return 0


class _StopError(BaseException):
    """A stop before the daemon runs: nothing is open yet that would have to be closed in order."""


@contextmanager
def _stop_during_start_up(hangups: list[int]) -> Iterator[None]:
    """Importing CasADi and compiling a new model take seconds, in which a stop must be as clean as later.

    Args:
        hangups: SIGHUPs that have come, which ask for the configuration to be read again once the daemon runs.
    """

    def stop(number: int, _frame: FrameType | None) -> None:
        raise _StopError(signal.Signals(number).name)

    def hang_up(number: int, _frame: FrameType | None) -> None:
        hangups.append(number)

    handlers = dict.fromkeys(common.stop_signals(), stop)
    if not common.has_terminal():
        handlers[signal.SIGHUP] = hang_up
    previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def demo_drive() -> DriveConfig:
    """The simulated ageing motor of `run` without a config, its nominal values a good third off."""
    from servo_daemon.simulate import DEFAULT_AGEING, DEFAULT_J_M, DEFAULT_NOMINAL

    ageing = {name: list(texts) for name, texts in DEFAULT_AGEING.items()}
    return DriveConfig(nominal=dict(DEFAULT_NOMINAL), options={"J_m": DEFAULT_J_M, "ageing": ageing})


def configuration(arguments: argparse.Namespace) -> Config:
    """The config file with environment and flags on top."""
    config = load_config(arguments.config)
    if arguments.config is None:
        config = config.model_copy(update={"drive": (demo_drive(),)})
    flags = {k: getattr(arguments, k) for k in ("host", "port") if getattr(arguments, k) is not None}
    if flags:
        api = parse_config({"api": config.api.model_dump() | flags}, "command line").api
        config = config.model_copy(update={"api": api})
    return config


def follow_log_level(arguments: argparse.Namespace, config: Config) -> None:
    """`[log] level`, unless flag or environment say another."""
    if arguments.log_level is None:
        logging.getLogger().setLevel(config.log.level.upper())


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


def _loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """uvloop where there is one: a third of the cost of a request; None for asyncio's own."""
    try:
        import uvloop
    except ImportError:
        return None
    factory: Callable[[], asyncio.AbstractEventLoop] = uvloop.new_event_loop
    return factory
