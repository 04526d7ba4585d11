"""The distributions of what thresholds are compared with, and what each threshold makes of them.

Of a threshold that decides whether something is there, each run counts by its most telling statistic: where nothing is
to be found the share of runs beyond the threshold is that of false alarms, elsewhere the rest were missed by this
threshold (others may have caught them, and an alarm needs several to agree). Of the others all comparisons are shown.
The tracker's are those of the second half, when its filter has found its values (`cases._track`).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from tests.recovery.calibration.cases import Result

_EVIDENCE, _JUMPS = "diagnosis.search.evidence", "tracking.changes.search"
_NOISE, _WATCH, _FUSION = "tracking.noise.levels", "tracking.noise.watch", "tracking.validity.fusion"
#: On which side of a threshold something is there: an effect, structure in what is left, a change of the motor, a model
#: that lacks something, a value that is not known.
SPEAKS: Mapping[str, str] = {
    f"{_EVIDENCE}.LEAST_GAIN": "above",
    f"{_EVIDENCE}.LEAST_BIC": "below",
    f"{_EVIDENCE}.LEAST_SHARE": "above",
    f"{_EVIDENCE}.LEAST_OWN": "above",
    f"{_EVIDENCE}.LEAST_TOGETHER": "above",
    f"{_EVIDENCE}.NESTED_GAIN": "above",
    f"{_EVIDENCE}.OVERWHELMING_BIC": "below",
    f"{_EVIDENCE}._UNSEEN_BIC": "below",
    f"{_EVIDENCE}._CLEARLY": "above",
    f"{_EVIDENCE}.PLAINLY": "above",
    f"{_EVIDENCE}._LITTLE_LOST": "above",
    f"{_EVIDENCE}._LEAST_OF_ALL": "above",
    "diagnosis.verdict.remains._LEFT": "above",
    "diagnosis.screening.dependence.LEAST_SHARE": "above",
    "diagnosis.screening.dependence.LEAST_SIZE": "above",
    "diagnosis.search.fitting.COLOURED": "below",
    "diagnosis.trial.likelihood._LIKELIER": "above",
    "diagnosis.trial.likelihood._PLAINLY": "above",
    "diagnosis.search.unscreened.PROMISING": "above",
    "identification.output_error.noise.residual.RELEVANT": "above",
    "identification.output_error.noise.residual._SIGNIFICANT": "above",
    f"{_WATCH}.WHITE_IN": "above",
    f"{_WATCH}.WHITE_OUT": "above",
    f"{_WATCH}._UNEXPLAINED[0]": "above",
    f"{_WATCH}._UNEXPLAINED[1]": "above",
    f"{_WATCH}._UNEXPLAINED_NIS": "above",
    f"{_WATCH}._GATED_SHARE": "above",
    f"{_NOISE}._NIS_HIGH": "above",
    f"{_NOISE}._CORRELATED": "above",
    "tracking.restart.divergence._DIVERGED_NIS": "above",
    "tracking.validity.gates.QUALIFIED": "above",
    "tracking.validity.gates.LOST": "above",
    "regression.estimate.KNOWS": "above",
    f"{_FUSION}.AGREES": "above",
    f"{_JUMPS}._CHANGED": "above",
    f"{_JUMPS}._MARGIN": "above",
    f"{_JUMPS}._STEPPED_STDS": "above",
    f"{_JUMPS}._MOVED_STDS": "above",
    f"{_JUMPS}._MOVED_SHARE": "above",
    "tracking.changes.trials._NIS_MORE": "above",
    "tracking.changes.jumps._RULE": "above",
    "tracking.changes.actions._WANDERS": "above",
    "tracking.changes.actions._NOTICEABLE": "above",
    "regression.rls_fit.CHANCE_STDS": "above",
    "tracking.validity.excitation.SYSTEMATIC_LEAVE": "above",
    "tracking.restart.maximum_likelihood._WHITE": "above",
    "tracking.restart.maximum_likelihood._AS_EXPECTED": "above",
    "tracking.restart.batch_passes._AS_EXPECTED": "above",
    "tracking.notifications._OFFSET_OUT": "above",
}
_NOTHING = "nothing"


def table(results: Sequence[Result]) -> str:
    """All thresholds of a part, those that decide first, then what became of the runs."""
    groups: dict[str, list[Result]] = defaultdict(list)
    for r in results:
        groups[r.case.group].append(r)
    names = sorted({name for r in results for name in r.seen}, key=lambda n: (n not in SPEAKS, n))
    lines = []
    for name in names:
        value = next(r.seen[name][0] for r in results if name in r.seen)
        lines.append(f"{name} = {value:g}, {SPEAKS.get(name, 'all comparisons')}")
        for group, own in sorted(groups.items(), key=lambda item: (item[0] != _NOTHING, item[0])):
            lines.append(f"    {group:9s} {_line(name, value, group == _NOTHING, own)}")
    return "\n".join([*lines, "", *_outcomes(results)])


def _line(name: str, value: float, nothing: bool, own: Sequence[Result]) -> str:
    """Of one group: how many runs compared at all, 5, 50 and 95 %, and the shares."""
    seen = [np.array(r.seen[name][1]) for r in own if name in r.seen]
    if not seen:
        return f"{0:3d} of {len(own):3d} runs"
    side = SPEAKS.get(name)
    if side is None:
        every = np.concatenate(seen)
        return f"{len(seen):3d} of {len(own):3d} runs  {_spread(every)}  above {np.mean(every > value):6.1%}"
    telling = np.array([s.max() if side == "above" else s.min() for s in seen])
    beyond = int(np.sum(telling > value if side == "above" else telling < value))
    # A run that never came to this comparison was stopped by another threshold: it is no alarm of this one.
    share = f"false alarms {beyond / len(own):6.1%}" if nothing else f"missed {1 - beyond / len(own):6.1%}"
    return f"{len(seen):3d} of {len(own):3d} runs  {_spread(telling)}  beyond {beyond:3d}, {share}"


def _spread(values: Iterable[float]) -> str:
    low, middle, high = np.quantile(np.asarray(list(values)), [0.05, 0.5, 0.95])
    return f"{low:10.3g} {middle:10.3g} {high:10.3g}"


def _outcomes(results: Sequence[Result]) -> Iterator[str]:
    """What was named, or told, in how many runs of each kind."""
    kinds: dict[tuple[str, str], list[Result]] = defaultdict(list)
    for r in results:
        kinds[r.case.group, r.case.what].append(r)
    for (group, what), own in sorted(kinds.items()):
        told = Counter(" + ".join(r.outcome) or "–" for r in own)
        verdict = "" if own[0].right is None else f" {sum(bool(r.right) for r in own)} of {len(own)} right:"
        yield f"{group:9s} {what}:{verdict} " + ", ".join(f"{name} ({n})" for name, n in told.most_common())
