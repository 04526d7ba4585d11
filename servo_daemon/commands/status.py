"""`servo-daemon status`: a running daemon in the terminal."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from servo_daemon.commands.shared import common, daemon_http
from servo_daemon.errors import ServoDaemonError

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

HELP = "a running daemon in the terminal: every drive, what is known of it, what to look at"
EXAMPLE = """  servo-daemon status
  servo-daemon status http://192.168.1.20:8077 --watch"""

#: From one look to the next with `--watch`, s.
_EVERY_S: Final = 1.0
#: More drives than these are shown in one line each.
_IN_FULL: Final = 4
_COLOURS: Final = {
    "connected": "green", "connecting": "yellow", "silent": "yellow", "down": "red", "ended": "dim",
    "tracking": "green", "unexcited": "cyan", "estimating": "dim", "at_bound": "yellow", "fixed": "", "invalid": "red",
}  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("url", nargs="?", default=daemon_http.URL, metavar="URL", help=f"default: {daemon_http.URL}")
    parser.add_argument("--watch", action="store_true", help="again every second, until Ctrl-C")
    common.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.live import Live

    fleet = daemon_http.document(arguments.url, "/fleet")
    if arguments.json:
        common.print_json(fleet)
        return 0
    console = Console()
    if not arguments.watch:
        console.print(rendered(fleet, time.time()))
        return 0
    with Live(rendered(fleet, time.time()), console=console, auto_refresh=False) as live:
        while True:
            time.sleep(_EVERY_S)
            try:
                live.update(rendered(daemon_http.document(arguments.url, "/fleet"), time.time()), refresh=True)
            except ServoDaemonError as error:
                live.update(f"[red]{error}[/red]", refresh=True)


def rendered(fleet: Mapping[str, Any], now_s: float) -> RenderableType:
    """The fleet document for the terminal."""
    from rich.console import Group
    from rich.text import Text

    parts: list[RenderableType] = [Text(f"problem: {p}", style="bold red") for p in fleet["problems"]]
    parts += [_overview(fleet, now_s), _in_words(fleet, now_s)]
    if len(fleet["drives"]) <= _IN_FULL:
        parts += [_parameters(d) for d in fleet["drives"]]
    return Group(*parts)


def _overview(fleet: Mapping[str, Any], now_s: float) -> Table:
    from rich.text import Text

    table = _table("drive", "connection", "sample", "known", "alarms")
    for d in fleet["drives"]:
        tracking = sum(n for status, n in d["statuses"].items() if status in ("tracking", "unexcited", "fixed"))
        table.add_row(
            Text(d["name"] + (" (simulated)" if d["simulated"] else "")),
            Text(d["connection"], style=_COLOURS.get(d["connection"], "")),
            Text(_ago(d["time"], now_s)),
            Text(f"{tracking} of {sum(d['statuses'].values())}"),
            Text(", ".join(d["alarms"]), style="bold red"),
        )
    return table


def _in_words(fleet: Mapping[str, Any], now_s: float) -> Table:
    """What to look at and the last events. Under the overview and not in it: sentences need the terminal's width."""
    from rich.text import Text

    table = _table("drive", "when", "what")
    for d in fleet["drives"]:
        if worst := d["worst"]:
            table.add_row(Text(d["name"]), Text("now"), Text(f"{worst['parameter']}: {worst['why']}", style="yellow"))
        if event := d["last_event"]:
            table.add_row(Text(d["name"]), Text(_ago(event["time"], now_s)), Text(event["message"]))
    return table


def _table(*columns: str, title: str | None = None) -> Table:
    """Narrow: no lines between columns. The last column takes what is left of the width, the others are not broken."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, title=title, title_justify="left", pad_edge=False, padding=(0, 1, 0, 0))
    for name in columns:
        table.add_column(name, no_wrap=name != columns[-1])
    return table


def _parameters(drive: Mapping[str, Any]) -> Table:
    from rich.text import Text

    model = ", ".join(drive["model"]) or "the linear motor"
    table = _table("", "value ± 1 σ", "unit", "from nominal", "status", title=f"{drive['name']}: {model}")
    for name, p in drive["parameters"].items():
        change = p["change_percent"]
        table.add_row(
            Text(name),
            Text(with_std(p["value"], p["std"])),
            Text(p["unit"]),
            Text("" if change is None else f"{change:+.1f} %", justify="right"),
            Text(p["status"].replace("_", " "), style=_COLOURS.get(p["status"], "")),
        )
    return table


def with_std(value: float | None, std: float | None) -> str:
    """A value with as many digits as its standard deviation leaves: 0.6391 ± 0.0012."""
    if value is None:
        return "–"
    if std is None or not std > 0:
        return f"{value:.4g}"
    decimals = 1 - math.floor(math.log10(std))
    if not -1 <= decimals <= 6:
        return f"{value:.6g} ± {std:.2g}"
    return f"{value:.{max(0, decimals)}f} ± {std:.{max(0, decimals)}f}"


def _ago(text: str | None, now_s: float) -> str:
    if text is None:
        return "never"
    seconds = max(0.0, now_s - datetime.fromisoformat(text).astimezone(UTC).timestamp())
    for unit, length in (("d", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"
