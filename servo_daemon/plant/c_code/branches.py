"""A step that computes of its case distinctions what applies: the generated code of one, reordered.

CasADi writes both sides of a distinction one after the other and takes `c ? x : 0` of each; of a motor's step with its
derivatives two in five operations are of a case that does not apply. Here whatever only such a value needs stands
behind `if (c)`. The operations that are left are the same ones on the same numbers.
"""

from __future__ import annotations

import heapq
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from servo_daemon.plant.c_code.lanes import body_of

#: Of fewer of a step's statements it is not worth the jumps (free within 0.02 .. 0.1: steps have none or more).
_WORTH_BRANCHES = 0.05
_NAME = re.compile(r"\ba\d+\b")
_ASSIGNED = re.compile(r"^(a\d+)=(.*);$")
_CHOSEN = re.compile(r"^\((v\d+)\?(v\d+):0\)$")

#: Conditions under which a statement is needed, the outermost first.
Guard = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Statement:
    """A statement, every value with a name of its own.

    Attributes:
        target: the value that it makes; None: it stores a result.
        text: its right-hand side, or all of it.
        needs: values in it.
    """

    target: str | None
    text: str
    needs: tuple[str, ...]

    @property
    def code(self) -> str:
        return self.text if self.target is None else f"{self.target}={self.text};"


def with_branches(source: str) -> str:
    """Generated code whose step computes no case that does not apply; as it is where there is little of that.

    Args:
        source: with a function `step`; its calls may be written as `SD_ONCE`.
    """
    body = body_of(source)
    if body is None:
        return source
    statements = _named(body)
    guards = _guards(statements)
    if sum(map(bool, guards)) < _WORTH_BRANCHES * len(statements):
        return source
    names = [s.target for s in statements if s.target is not None]
    lines = [f"casadi_real {', '.join(names)};", *_in_blocks(statements, guards), "return 0;", "}"]
    return source.replace("\n".join(body), "\n".join(lines))


def _named(body: Iterable[str]) -> list[Statement]:
    """The statements of a body without declarations, every value with a name of its own."""
    now: dict[str, str] = {}
    out: list[Statement] = []
    for line in map(str.strip, body):
        if line.startswith("casadi_real ") or line in ("return 0;", "}"):
            continue
        made = _ASSIGNED.match(line)
        text = _NAME.sub(lambda name: now[name[0]], line if made is None else made[2])
        target = None
        if made is not None:
            target = now[made[1]] = f"v{len(out)}"
        out.append(Statement(target, text, tuple(dict.fromkeys(re.findall(r"\bv\d+\b", text)))))
    return out


def _guards(statements: Sequence[Statement]) -> list[Guard]:
    """The guard of each statement."""
    needed: dict[str, Guard] = {}
    out: list[Guard] = []
    for s in reversed(statements):
        guard = () if s.target is None else needed.get(s.target, ())
        out.append(guard)
        chosen = _CHOSEN.match(s.text)
        for value in s.needs:
            use = guard
            if chosen is not None and value == chosen[2] and value != chosen[1]:
                use = (*guard, chosen[1])
            needed[value] = _common(needed[value], use) if value in needed else use
    return out[::-1]


def _common(one: Guard, other: Guard) -> Guard:
    same = 0
    for a, b in zip(one, other, strict=False):
        if a != b:
            break
        same += 1
    return one[:same]


def _in_blocks(statements: Sequence[Statement], guards: Sequence[Guard]) -> Iterator[str]:
    """The statements so that those with one guard stand together, otherwise in their order."""
    at = {s.target: k for k, s in enumerate(statements) if s.target is not None}
    users: defaultdict[int, list[int]] = defaultdict(list)
    missing = []
    for k, s in enumerate(statements):
        needs = {at[value] for value in (*s.needs, *guards[k])}
        missing.append(len(needs))
        for made in needs:
            users[made].append(k)
    ready: defaultdict[Guard, list[int]] = defaultdict(list)
    for k, n in enumerate(missing):
        if n == 0:
            heapq.heappush(ready[guards[k]], k)
    while any(ready.values()):
        guard = min((g for g, waiting in ready.items() if waiting), key=lambda g: (len(g), ready[g][0]))
        if guard:
            yield f"if ({' && '.join(guard)}) {{"
        while ready[guard]:
            done = heapq.heappop(ready[guard])
            yield statements[done].code
            for user in users[done]:
                missing[user] -= 1
                if missing[user] == 0:
                    heapq.heappush(ready[guards[user]], user)
        if guard:
            yield "}"
