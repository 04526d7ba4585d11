"""`deploy/manpages.py FOLDER`: manual pages, from what the commands say of themselves and the example configuration.

One page for each command (`man servo-daemon fit`), one over all (`man servo-daemon`), and servo-daemon.toml(5).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from servo_daemon import __version__
from servo_daemon.cli import _parser

ROOT = Path(__file__).resolve().parents[1]
#: What argparse wraps its usage to, so that a page does not depend on the terminal it is made in.
_WIDTH = 78


def escaped(text: str) -> str:
    """Plain text as roff reads it: backslashes, hyphens that are typed, and dots that begin a line."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return "\n".join(f"\\&{line}" if line.startswith((".", "'")) else line for line in text.split("\n"))


def page(name: str, section: int, summary: str, *parts: tuple[str, str]) -> str:
    """A page of (heading, roff) parts."""
    head = f'.TH "{escaped(name.upper())}" {section} "" "servo\\-daemon {escaped(__version__)}"\n'
    body = "".join(f".SH {heading}\n{text.strip()}\n" for heading, text in parts)
    return f"{head}.SH NAME\n{escaped(name)} \\- {escaped(summary)}\n{body}"


def verbatim(text: str) -> str:
    """Lines as they are."""
    return f".nf\n{escaped(text.strip(chr(10)))}\n.fi"


def _usage(parser: argparse.ArgumentParser) -> str:
    parser.formatter_class = lambda prog: argparse.HelpFormatter(prog, width=_WIDTH)  # type: ignore[assignment]
    return verbatim(parser.format_usage().removeprefix("usage: "))


def _options(parser: argparse.ArgumentParser) -> Iterator[str]:
    """A .TP paragraph for each flag and argument, with its help."""
    formatter = argparse.HelpFormatter("")
    for action in parser._actions:  # argparse shows them nowhere else
        if action.help == argparse.SUPPRESS:
            continue
        if isinstance(action, argparse._SubParsersAction):
            for choice in action._choices_actions:
                yield f".TP\n.B {escaped(choice.dest)}\n{escaped(choice.help or '')}"
            continue
        words = formatter._format_action_invocation(action)
        yield f".TP\n.B {escaped(words)}\n{escaped(formatter._expand_help(action) if action.help else '')}"


def pages() -> Iterator[tuple[str, str]]:
    """File names and texts."""
    parser = _parser()
    commands = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    summaries = {choice.dest: choice.help or "" for choice in commands._choices_actions}
    for name, sub in commands.choices.items():
        epilog = (sub.epilog or "").removeprefix("example:\n")
        yield (
            f"servo-daemon-{name}.1",
            page(
                f"servo-daemon-{name}",
                1,
                summaries[name],
                ("SYNOPSIS", _usage(sub)),
                ("DESCRIPTION", escaped(sub.description or "")),
                ("OPTIONS", "\n".join(_options(sub))),
                ("EXAMPLES", verbatim(epilog)),
                ("SEE ALSO", ".BR servo\\-daemon (1),\n.BR servo\\-daemon.toml (5)"),
            ),
        )
    yield (
        "servo-daemon.1",
        page(
            "servo-daemon",
            1,
            "parameter estimation for live DC servo drives",
            ("SYNOPSIS", _usage(parser)),
            ("DESCRIPTION", escaped(parser.description or "")),
            ("COMMANDS", "\n".join(_options(parser))),
            ("FILES", ".TP\n.I /etc/servo\\-daemon/servo\\-daemon.toml\nthe configuration of the service"),
            ("SEE ALSO", ".BR servo\\-daemon.toml (5)\nand, for each command, such as\n.BR servo\\-daemon\\-run (1)"),
        ),
    )
    example = (ROOT / "deploy" / "example.toml").read_text(encoding="utf-8")
    yield (
        "servo-daemon.toml.5",
        page("servo-daemon.toml", 5, "configuration of servo-daemon", ("EVERY KEY, EXPLAINED", verbatim(example))),
    )


def main() -> None:
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages():
        (folder / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
