"""The command line: parse, dispatch, and turn every error into one line and an exit code.

Exit codes: 0 done, whatever the verdict; 1 failed; 2 bad input or usage; 130 interrupted. With `--json` stdout is
exactly one JSON document; logs, notes and progress go to stderr.
"""

from __future__ import annotations

import argparse
import importlib
import json
import logging
import os
import sys
from collections.abc import Callable, Sequence
from typing import Protocol, cast

from servo_daemon import __version__
from servo_daemon.errors import ServoDaemonError

log = logging.getLogger("servo_daemon")

#: command -> module with `add_arguments(parser)`, `run(arguments) -> exit code`, `HELP` and `EXAMPLE`. A command's own
#: imports (CasADi, uvicorn, …) are paid only when it is the one that runs.
COMMANDS = {
    "run": "servo_daemon.commands.run",
    "simulate": "servo_daemon.commands.simulate",
    "sim-drive": "servo_daemon.commands.sim_drive",
    "record": "servo_daemon.commands.record",
    "replay": "servo_daemon.commands.replay",
    "check": "servo_daemon.commands.check",
}


class _Command(Protocol):
    HELP: str
    EXAMPLE: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="servo-daemon", description="Online, self-explaining parameter estimation for a live DC servo drive."
    )
    parser.add_argument("--version", action="version", version=f"servo-daemon {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, module_name in COMMANDS.items():
        module = cast(_Command, importlib.import_module(module_name))
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
            default=os.environ.get("SERVO_DAEMON_LOG_LEVEL", "info"),
            help="what goes to stderr (default: info)",
        )
        sub.set_defaults(run=module.run)
    return parser


class _PriorityFormatter(logging.Formatter):
    """Lines for systemd's journal: `<priority>` in front, no time stamp (the journal has its own); see sd-daemon(3)."""

    _PRIORITY = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))

    def format(self, record: logging.LogRecord) -> str:
        priority = next((p for level, p in self._PRIORITY if record.levelno >= level), 7)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())


def _set_up_logging(level: str) -> None:
    handler = logging.StreamHandler(sys.stderr)
    if os.environ.get("JOURNAL_STREAM"):
        handler.setFormatter(_PriorityFormatter("%(name)s: %(message)s"))
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    arguments = _parser().parse_args(argv)
    _set_up_logging(arguments.log_level)
    try:
        return int(arguments.run(arguments))
    except ServoDaemonError as error:
        print(f"servo-daemon {arguments.command}: {error}", file=sys.stderr)
        if getattr(arguments, "json", False):
            print(json.dumps({"error": str(error)}))
        return error.exit_code
    except KeyboardInterrupt:
        print(f"servo-daemon {arguments.command}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output went away, as `head` does
        sys.stderr.close()
        return 1
