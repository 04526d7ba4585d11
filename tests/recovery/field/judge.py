"""What the program makes of a file: each command as its user runs it, against the truth."""

from __future__ import annotations

import json
import re
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.command_line import Result, run_command
from tests.recovery.field.draws import SEEDS
from tests.recovery.field.dressed import Dressed, Mend
from tests.recovery.field.dressings import DRESSINGS, dress

#: A number is wrong beyond so many of its standard deviations and this share of the truth.
STDS, SHARE = 4.0, 0.05
#: Between these a product is meant: "J R", ") (", "K² R".
_PRODUCT = re.compile(r"(?<=[A-Za-z0-9_²)]) (?=[A-Za-z(])")


@dataclass(frozen=True, slots=True)
class FieldCase:
    """One file; `diagnosed`: `diagnose` is run as well."""

    kind: str
    seed: int
    diagnosed: bool = False

    @property
    def key(self) -> str:
        return f"{self.kind}/{self.seed}/{self.diagnosed}"


@dataclass(frozen=True, slots=True)
class Number:
    """A value with a standard deviation that the program gave."""

    name: str
    value: float
    std: float
    true: float

    @property
    def wrong(self) -> bool:
        return abs(self.value - self.true) > max(STDS * self.std, SHARE * abs(self.true))


@dataclass(frozen=True, slots=True)
class Judgement:
    """What came of a file.

    Attributes:
        motor: its name.
        claimed: numbers that count: of the file that means what it says, or once it is mended; and of a file that had
            to be mended and was not told to be.
        missing: what the file, mended where needed, determines and was given no value.
        told: "" nothing to mend; "refused", "warned" with the mend in it; "unsaid". A file that means what it says and
            is "refused" has None in `mended`.
        mended: whether the mend gave all that is determined, and none of it wrong; None: nothing to mend.
        named, wrong_names: effects of the diagnosis.
        message: what was said first, for the curious.
        seconds: of all commands.
    """

    case: FieldCase
    motor: str
    claimed: tuple[Number, ...]
    missing: tuple[str, ...]
    told: str
    mended: bool | None
    named: tuple[str, ...]
    wrong_names: tuple[str, ...]
    message: str
    seconds: float


def true_of(expression: str, truth: Mapping[str, float]) -> float | None:
    """A parameter's or a combination's true value, "(J R + L B)/(B R + K²)" as printed; None: it is not known."""
    code = _PRODUCT.sub(" * ", expression).replace("²", "**2")
    if not set(re.findall(r"[A-Za-z]\w*", code)) <= set(truth):
        return None
    return float(eval(code, {"__builtins__": {}}, dict(truth)))


def numbers(document: Mapping[str, Any], truth: Mapping[str, float]) -> tuple[Number, ...]:
    """All that a fit's document claims and whose truth is known: parameters and combinations."""
    rows = [(name, row["value"], row["std"]) for name, row in document["parameters"].items()]
    rows += [(row["expression"], row["value"], row["std"]) for row in document["combinations"]]
    claimed = [(name, v, s, true_of(name, truth)) for name, v, s in rows if v is not None and s is not None]
    return tuple(Number(name, v, s, true) for name, v, s, true in claimed if true is not None)


def judge(case: FieldCase) -> Judgement:
    """Writes the file, runs the commands, compares."""
    began = time.perf_counter()
    of = dress(case.kind, case.seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / of.name
        path.write_bytes(of.text)
        first = run_command("fit", path, *of.words, "--json")
        message = _said(first)
        if of.mend is None:
            counted = () if first.code else numbers(first.document, of.truth)
            told, mended = "refused" if first.code else "", None
            missing = _missing(counted, of.expects)
            named = _diagnosed(path, of) if case.diagnosed and not first.code else ()
        else:
            told = _told(first, message, of.mend)
            again = _mended(path, of, of.mend, message) if told != "unsaid" else None
            after = () if again is None or again.code else numbers(again.document, of.truth)
            missing = _missing(after, of.mend.expects)
            mended = not missing and not any(n.wrong for n in after)
            as_it_is = first.code == 0 and (told == "unsaid" or of.told_only)
            counted, named = (*(numbers(first.document, of.truth) if as_it_is else ()), *after), ()
    right = {e for e, also in named if {e, *also} & set(of.hidden)}
    names = tuple(e for e, _ in named)
    wrong = tuple(e for e in names if e not in right)
    spent = round(time.perf_counter() - began, 2)
    return Judgement(case, of.motor, counted, missing, told, mended, names, wrong, message[:600], spent)


def _said(result: Result) -> str:
    """All that a user reads besides the values."""
    return result.err if result.code else "\n".join([result.err, *result.document["notes"]])


def _missing(found: Sequence[Number], expected: Sequence[str]) -> tuple[str, ...]:
    return tuple(sorted(set(expected) - {n.name for n in found}))


def _told(first: Result, message: str, mend: Mend) -> str:
    if not re.search(mend.says, message):
        return "unsaid"
    return "refused" if first.code else "warned"


def _mended(path: Path, of: Dressed, mend: Mend, message: str) -> Result | None:
    """With the flags that were asked for, or with the map that was offered; None: none was."""
    if mend.words:
        return run_command("fit", path, *of.words, *mend.words, "--json")
    line = re.search(r"signals = \{.*\} \}|signals = \{.*\}", message)
    if line is None:
        return None
    above = re.search(r"above it.*?(counts_per_rev = \S+)", message)
    told = f"{above[1] if above else ''}\n{line[0]}"
    for key, value in mend.put.items():
        told = re.sub(rf"{key} = [\d.e+-]+", f"{key} = {value}", told)
    made = path.with_suffix(".toml")
    made.write_text(told + "\n", encoding="utf-8")
    return run_command("fit", path, *of.words, "--signals", made, "--json")


def _diagnosed(path: Path, of: Dressed) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Names of effects, each with those that the diagnosis says fit as well."""
    flags = [w for w, name in zip(of.words, of.words[1:], strict=False) if w == "--effect"]
    if flags:
        return ()
    out = path.parent / "diagnosis"
    result = run_command("diagnose", path, *of.words, "--out", out)
    if result.code:
        raise RuntimeError(f"{path.name}: {result.err}")
    document = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    return tuple((e["name"], tuple(n for group in e["equivalent"] for n in group)) for e in document["effects"])


def cases(seed: int, count: int, diagnosed: int = 0) -> list[FieldCase]:
    """So many files, the kinds in turn, each with a seed of its own; `diagnosed`: every so many-th of those that mean
    what they say is diagnosed as well, 0: none."""
    kinds = [kind for group in DRESSINGS.values() for kind in group]
    first = SEEDS.start + 1_000_000 * seed
    chosen = [FieldCase(kinds[k % len(kinds)], first + k) for k in range(count)]
    if not diagnosed:
        return chosen
    # the kinds' own turns shift the choice, so that each kind has its own
    return [
        FieldCase(c.kind, c.seed, c.kind not in DRESSINGS["meaning"] and (k + k // len(kinds)) % diagnosed == 0)
        for k, c in enumerate(chosen)
    ]
