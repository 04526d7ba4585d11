"""The choice of blocks: an exact design, by greedy choice and exchange (Fedorov, *Theory of Optimal Experiments*,
1972)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from servo_daemon.experiment.questions import Question
from servo_daemon.samples import F64

#: Rounds of exchange; it ends when a whole round changes nothing.
_ROUNDS = 6
#: An exchange must be worth this much.
_WORTH = 1e-4


def choose(questions: Sequence[Question], sums: Sequence[Sequence[Sequence[F64]]], blocks: int) -> list[int]:
    """Members of the family, one for each block, in no particular order.

    Args:
        sums: for each question, member and draw the block's statistics.
        blocks: how many.
    """
    tables = [np.array(of_question) for of_question in sums]  # (members, draws, …)
    members = len(tables[0])

    def score(chosen: Sequence[int]) -> float:
        counts = np.bincount(chosen, minlength=members).astype(float)
        return sum(q.score(list(np.tensordot(counts, t, axes=1))) for q, t in zip(questions, tables, strict=True))

    chosen: list[int] = []
    for _ in range(blocks):
        chosen.append(_best(score, chosen, members)[1])
    for _ in range(_ROUNDS):
        before = score(chosen)
        for k in range(blocks):
            rest = chosen[:k] + chosen[k + 1 :]
            value, member = _best(score, rest, members)
            if value > score(chosen) + _WORTH:
                chosen = [*rest, member]
        if score(chosen) <= before:
            break
    return sorted(chosen)


def _best(score: Callable[[Sequence[int]], float], rest: Sequence[int], members: int) -> tuple[float, int]:
    return max((score([*rest, m]), m) for m in range(members))
