"""`servo-daemon completion`: what a shell needs to complete commands, flags, effects and files."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

HELP = "a script with which bash or zsh completes commands, flags, effects and files"
EXAMPLE = """  servo-daemon completion bash  # > ~/.local/share/bash-completion/completions/servo-daemon
  servo-daemon completion zsh   # > _servo-daemon in a folder of $fpath"""

#: Flags whose values are effects' names.
_EFFECTS = ("effect", "between")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=("bash", "zsh"))


def run(arguments: argparse.Namespace) -> int:
    """The script on stdout, of a parser of all commands."""
    import shtab

    from servo_daemon.plant.effects import effects_by_name

    parser: argparse.ArgumentParser = arguments.parser()
    for action in _actions(parser):
        if action.dest in _EFFECTS:
            action.choices = tuple(effects_by_name())
        elif action.type is Path:
            action.complete = shtab.DIRECTORY if action.metavar == "DIR" else shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, shell=arguments.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Flags and arguments of a parser and of its commands."""
    for action in parser._actions:  # argparse shows them nowhere else
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
