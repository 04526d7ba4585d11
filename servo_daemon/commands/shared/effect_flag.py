"""`--effect`: the flag of several commands, and the list of effects that `--effect help` prints."""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Sequence
from typing import Any

#: What `--effect` takes in place of a name, to list them.
_ASKS = ("help", "list")


class EffectAction(argparse.Action):
    """Collects effects; asked for help it lists those there are, and the program ends."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        _option: str | None = None,
    ) -> None:
        if values in _ASKS:
            print(effect_list(shutil.get_terminal_size((100, 24)).columns))
            parser.exit()
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), values])


def add_effect(parser: argparse.ArgumentParser, meaning: str) -> None:
    """`--effect`, repeatable; its texts go to `parse_effect`."""
    parser.add_argument(
        "--effect",
        action=EffectAction,
        default=[],
        metavar="NAME[:k=v,…]",
        help=f"{meaning}; repeatable; 'help' lists them",
    )


def effect_list(width: int) -> str:
    """Every effect with its parameters and its cause in one sentence, lines of at most `width` characters where words
    allow."""
    from servo_daemon.plant.effects import effects_by_name

    wrapper = textwrap.TextWrapper(max(width, 40), initial_indent="    ", subsequent_indent="    ")
    wrapper.break_on_hyphens = False
    lines = []
    for name, effect in effects_by_name().items():
        lines.append(f"{name} ({', '.join(p.name for p in effect.parameters)})")
        what = f"A further harmonic of {effect.further}." if effect.further else effect.cause
        lines += wrapper.wrap(what)
    return "\n".join(lines)
