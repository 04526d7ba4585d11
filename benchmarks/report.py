"""The measured tables of docs/benchmarks.md, from what the benchmarks print.

    python -m benchmarks.report --measure wire-serial cost   # run these (or: all), keep what they print, assemble
    python -m benchmarks.report                              # assemble only: make bench-report

What a benchmark prints is kept as it is in `benchmarks/results/NAME.json`, with command, date, commit, machine and how
long it took. In docs/benchmarks.md the lines between `<!-- bench NAME -->` and `<!-- /bench -->` are replaced by it.
A section without a result, or one that is not measured again, stays as it stands, with the date and commit in it.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
PAGE = ROOT / "docs" / "benchmarks.md"

_MONTE_CARLO = ("--runs", "2000", "--motors", "paper", "--motions", "multisine", "--noises", "laboratory")
#: What follows `python`, by section.
COMMANDS: Mapping[str, tuple[str, ...]] = {
    "wire-serial": ("benchmarks/wire_serial.py",),
    "wire-can": ("benchmarks/wire_can.py",),
    "polling": ("-m", "benchmarks.polling"),
    "captures": ("benchmarks/captures.py",),
    "ekf-step": ("benchmarks/ekf_step.py",),
    "daemon": ("benchmarks/daemon.py",),
    "life": ("-m", "benchmarks.life", "--filled", "1"),
    "kills": ("-m", "benchmarks.kills"),
    "page": ("-m", "benchmarks.page"),
    "neighbours": ("-m", "benchmarks.neighbours", "--seconds", "30"),
    "soak": ("-m", "benchmarks.soak", "--minutes", "3"),
    "heavy-steps": ("-m", "benchmarks.heavy_steps"),
    "identification": ("benchmarks/identification.py",),
    "identification-montecarlo": ("-m", "benchmarks.identification_montecarlo", *_MONTE_CARLO),
    "real": ("-m", "benchmarks.real"),
    "diagnosis": ("-m", "benchmarks.diagnosis"),
    "drives": ("-m", "benchmarks.drives", "--runs", "1"),
    "drive-effects": ("-m", "benchmarks.drive_effects"),
    "fleet": ("-m", "benchmarks.fleet", "--seconds", "0.3"),
    "commission": ("-m", "benchmarks.commission"),
    "real-axis": ("benchmarks/real_axis.py",),
    "excite": ("benchmarks/excite.py",),
    "learning": ("benchmarks/learning.py",),
    "refresh": ("benchmarks/refresh.py",),
    "life-trend": ("-m", "benchmarks.life_trend"),
    **{
        part: ("-m", "benchmarks.tracking", part)
        for part in (
            "bound",
            "realistic",
            "ageing",
            "scenarios",
            "steps",
            "starts",
            "witness",
            "steady",
            "published",
            "false-steps",
            "models",
            "rivals",
            "cost",
            "long",
        )
    },
}
_SECTION = re.compile(r"(<!-- bench ([a-z-]+) -->\n)(.*?)(<!-- /bench -->)", re.DOTALL)


@dataclass(frozen=True)
class Result:
    """One run of one benchmark. `commit` ends in "+" where the tree had changes that were not committed."""

    command: str
    date: str
    commit: str
    machine: str
    seconds: float
    output: str


def measure(name: str) -> Result:
    """Runs the benchmark of a section; what it prints is shown, too.

    Raises:
        KeyError: there is no such section.
        subprocess.CalledProcessError: the benchmark failed.
    """
    arguments = COMMANDS[name]
    began = time.monotonic()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, *arguments]
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            print(line, end="", flush=True)
            lines.append(line)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    seconds = round(time.monotonic() - began, 1)
    written = f"python {' '.join(arguments)}"
    return Result(written, time.strftime("%Y-%m-%d"), _commit(), _machine(), seconds, "".join(lines))


def markdown(result: Result) -> str:
    """A result as it stands on the page: where it comes from, tables as they are, all else as it was printed."""
    head = f"`{result.command}` · {result.date} · commit {result.commit} · {result.machine} · {result.seconds:.0f} s"
    parts = [head]
    for is_table, lines in groupby(result.output.splitlines(), key=lambda line: line.startswith("|")):
        text = "\n".join(lines).strip("\n")
        if text:
            parts.append(text if is_table else f"```text\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def assemble(page: str, results: Mapping[str, Result]) -> str:
    """The page with every section that has a result written anew; all else as it was.

    Raises:
        ValueError: the page has a section that no benchmark fills, or one twice, or no place for a result.
    """
    sections = [match[2] for match in _SECTION.finditer(page)]
    if unknown := set(sections) - set(COMMANDS):
        raise ValueError(f"no benchmark fills {', '.join(sorted(unknown))}")
    if len(set(sections)) < len(sections):
        raise ValueError("a section is there twice")
    if missing := set(results) - set(sections):
        raise ValueError(f"the page has no section for {', '.join(sorted(missing))}")

    def written(match: re.Match[str]) -> str:
        result = results.get(match[2])
        return match[0] if result is None else f"{match[1]}{markdown(result)}{match[4]}"

    return _SECTION.sub(written, page)


def load(folder: Path) -> dict[str, Result]:
    """Every result in a folder, by section."""
    return {path.stem: Result(**json.loads(path.read_text(encoding="utf-8"))) for path in sorted(folder.glob("*.json"))}


def save(folder: Path, name: str, result: Result) -> None:
    """Keeps a result in place of the section's last one."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(asdict(result), indent=1, ensure_ascii=False)
    (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")


def _commit() -> str:
    """The commit that is checked out."""
    version = _git("rev-parse", "--short", "HEAD")
    changed = _git("status", "--porcelain", "--", ".", ":!docs/benchmarks.md", ":!benchmarks/results")
    return f"{version}+" if changed else version


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def _machine() -> str:
    """Cores, processor, Python, and how busy all of it was in the last minute; no name of the machine."""
    try:
        found = re.search(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        found = None
    processor = found[1] if found else platform.processor() or platform.machine()
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{os.cpu_count()} cores, {processor}, Python {platform.python_version()}{load}"


def main(argv: Sequence[str] | None = None) -> int:
    """Measures what is named and writes the page; 1 if a benchmark failed (the others are kept)."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.report")
    names = f"all, {', '.join(COMMANDS)}"
    parser.add_argument("--measure", nargs="*", default=[], choices=["all", *COMMANDS], metavar="NAME", help=names)
    wanted = parser.parse_args(argv).measure
    failed = 0
    for name in COMMANDS if "all" in wanted else wanted:
        print(f"== {name}", flush=True)
        try:
            save(RESULTS, name, measure(name))
        except subprocess.CalledProcessError as error:
            print(f"{name}: {error}", file=sys.stderr)
            failed = 1
    PAGE.write_text(assemble(PAGE.read_text(encoding="utf-8"), load(RESULTS)), encoding="utf-8")
    return failed


if __name__ == "__main__":
    sys.exit(main())
