"""The command line: parse, dispatch, and turn every error into one line and an exit code.

Exit codes: 0 done, whatever the verdict; 1 failed; 2 bad input or usage; 130 interrupted. With `--json` stdout is
exactly one JSON document; logs, notes and progress go to stderr.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import json
import logging
import os
import sys
from collections.abc import Callable, Collection, Sequence
from typing import Any, NoReturn, Protocol, cast

from servo_daemon import __version__
from servo_daemon.errors import ServoDaemonError
from servo_daemon.journal import SOCKET, JournalHandler, is_journal, priority

log = logging.getLogger("servo_daemon")

#: command -> module with `add_arguments(parser)`, `run(arguments) -> exit code`, `HELP` and `EXAMPLE`. It is imported
#: only where it is the one that is called, or where the help tells of all.
COMMANDS = {
    "run": "servo_daemon.commands.run.command",
    "simulate": "servo_daemon.commands.simulate",
    "sim-drive": "servo_daemon.commands.sim_drive",
    "record": "servo_daemon.commands.record",
    "replay": "servo_daemon.commands.replay.command",
    "fit": "servo_daemon.commands.fit.command",
    "compare": "servo_daemon.commands.compare.command",
    "diagnose": "servo_daemon.commands.diagnose.command",
    "excite": "servo_daemon.commands.excite.command",
    "commission": "servo_daemon.commands.commission.command",
    "tune": "servo_daemon.commands.tune.command",
    "train": "servo_daemon.commands.train",
    "fleet": "servo_daemon.commands.fleet.command",
    "check": "servo_daemon.commands.check",
    "config": "servo_daemon.commands.config",
    "scan": "servo_daemon.commands.scan.command",
    "status": "servo_daemon.commands.status",
    "export": "servo_daemon.commands.export.command",
    "export-history": "servo_daemon.commands.export_history",
    "token": "servo_daemon.commands.token",
    "completion": "servo_daemon.commands.completion",
}


class _Command(Protocol):
    HELP: str
    EXAMPLE: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


class _UsageError(Exception):
    """The command line makes no sense; the text says why."""

    def __init__(self, program: str, usage: str, message: str) -> None:
        super().__init__(message)
        self.program, self.usage = program, usage


class _Parser(argparse.ArgumentParser):
    """Raises where argparse would end the process, so that `--json` gets its document."""

    def error(self, message: str) -> NoReturn:
        raise _UsageError(self.prog, self.format_usage(), message)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """As argparse does it; an unknown flag is refused here, where the flags of its command are known."""
        parsed, extras = super().parse_known_args(args, namespace)
        if any(word.startswith("-") for word in extras):
            self.error(f"unrecognized arguments: {' '.join(extras)}{self._meant(extras)}")
        return parsed, extras

    def _meant(self, words: Sequence[str]) -> str:
        """To follow the message: " (did you mean --fix?)"; empty where no flag is like one of the words."""
        flags = {flag.lstrip("-"): flag for action in self._actions for flag in action.option_strings}
        unknown = (word.partition("=")[0].lstrip("-").lower().replace("_", "-") for word in words if word[0] == "-")
        like = [flags[name] for word in unknown for name in difflib.get_close_matches(word, flags, 1)]
        return f" (did you mean {', '.join(like)}?)" if like else ""


def _parser(names: Collection[str] = COMMANDS) -> argparse.ArgumentParser:
    """The parser of these commands, with their options."""
    parser = _Parser(
        prog="servo-daemon", description="Online, self-explaining parameter estimation for a live DC servo drive."
    )
    parser.add_argument("--version", action="version", version=f"servo-daemon {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in names:
        module = cast(_Command, importlib.import_module(COMMANDS[name]))
        sub = commands.add_parser(
            name,
            help=module.HELP,
            description=module.HELP[0].upper() + module.HELP[1:] + ".",
            epilog=f"example:\n{module.EXAMPLE}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(sub)
        sub.add_argument(
            "--log-level",
            choices=("debug", "info", "warning", "error"),
            default=os.environ.get("SERVO_DAEMON_LOG_LEVEL"),
            help="what goes to stderr (default: info)",
        )
        sub.set_defaults(run=module.run, parser=_parser)
    return parser


def _called(words: Sequence[str]) -> Collection[str]:
    """The command that these words call; all where they may ask for the list of them."""
    first = words[0] if words else ""
    if first == "--version":
        return ()
    return (first,) if first in COMMANDS else COMMANDS


def _fail(program: str, text: str, code: int, as_json: bool) -> int:
    """Say what went wrong, on stderr and, where a document is expected, in one."""
    print(f"{program}: {text}", file=sys.stderr)
    if as_json:
        print(json.dumps({"error": text}, ensure_ascii=False))
    return code


class _PriorityFormatter(logging.Formatter):
    """Lines for systemd's journal: `<priority>` in front, no time stamp (the journal has its own); see sd-daemon(3)."""

    def format(self, record: logging.LogRecord) -> str:
        return "\n".join(f"<{priority(record.levelno)}>{line}" for line in super().format(record).splitlines())


def _set_up_logging(level: str) -> None:
    handler: logging.Handler = logging.StreamHandler(sys.stderr)
    if os.environ.get("JOURNAL_STREAM"):
        handler.setFormatter(_PriorityFormatter("%(name)s: %(message)s"))
        if SOCKET.exists() and is_journal(2):  # stderr is its stream: then with fields of its own
            handler = JournalHandler(handler)
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    # Comes along with pandas, where that is installed for MDF files, and tells everybody how many threads it has.
    logging.getLogger("numexpr").setLevel(logging.WARNING)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    words = sys.argv[1:] if argv is None else list(argv)
    try:
        arguments = _parser(_called(words)).parse_args(words)
    except _UsageError as error:
        print(error.usage, end="", file=sys.stderr)
        return _fail(error.program, str(error), 2, as_json="--json" in words)
    _set_up_logging(arguments.log_level or "info")
    as_json = getattr(arguments, "json", False)
    name = f"servo-daemon {arguments.command}"
    try:
        return int(arguments.run(arguments))
    except ServoDaemonError as error:
        return _fail(name, str(error), error.exit_code, as_json)
    except KeyboardInterrupt:
        return _fail(name, "interrupted", 130, as_json)
    except BrokenPipeError:  # the reader of our output went away, as `head` does
        sys.stderr.close()
        return 1
