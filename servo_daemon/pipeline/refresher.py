"""A trained model beside one drive's filter, inside the pipeline: fed every tick, published, and let into the filter.

Pure, like the pipeline: what it says depends on the samples, the model and when it was given, on nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from servo_daemon.kalman.gaussian import Gaussian
from servo_daemon.published.snapshot import EstimatorView, finite_or_none
from servo_daemon.samples import SampleBlock
from servo_daemon.tracking.changes.jumps import JUMPED
from servo_daemon.tracking.plan.settings import Message
from servo_daemon.tracking.plant_tracker import PlantTracker
from servo_daemon.tracking.tracker import Tracker
from servo_daemon.tracking.validity.fusion import Fused
from servo_daemon.tracking.validity.gates import LOST

if TYPE_CHECKING:  # scikit-learn takes a second to load: only where there is a model
    from servo_daemon.learning.model.model import LearnedModel
    from servo_daemon.learning.refresh.refresh import PseudoMeasurement, RefreshEstimate

#: A filter that needs it again and again is not to fill the list of events, s.
_TELL_EVERY_S = 60.0
#: What a window said is of the motor of then: it counts for so many refreshes (chosen; not tried).
_COUNTS_FOR = 2.5
_WHY_TRACKING = "RF+GRNN estimate of the last windows: the filter does not know it as well"


class Refresher:
    """Feeds one drive's ticks to the learned model, and its estimates to the filter.

    Args:
        model: trained for this drive.
        published: names of the parameters that this drive publishes.
        every_s: from one window to the next.

    Attributes:
        view: what is published as `estimators.grnn`.
    """

    def __init__(self, model: LearnedModel, published: tuple[str, ...], every_s: float) -> None:
        from servo_daemon.learning.refresh.recent import Recent
        from servo_daemon.learning.refresh.refresh import Refresh

        self.model = model
        self._refresh = Refresh(model, every_s)
        self._recent = Recent(_COUNTS_FOR * self._refresh.every_s)
        self._examines = False
        self._changed_s = -math.inf
        self._published = frozenset(published)
        self._windows = self._declined = self._applied = 0
        self._applied_s: float | None = None
        self._effect: dict[str, float] = {}
        self._told_s = -math.inf
        self.view = self._make_view(None)

    def take(self, tick: SampleBlock, tracker: Tracker, told: Sequence[Message] = ()) -> list[Message]:
        """The samples of a tick that the filter has seen; what is worth telling.

        Args:
            told: what the filter had to say of that tick.
        """
        self._watch_jumps(tracker, told)
        found = self._refresh.update(tick, lambda: _estimate(tracker))
        if found is None:
            return []
        if found.time_s - self.model.spec.window_s < self._changed_s:
            found = replace(found, pseudo=None, reason="the motor changed during the window")
        elif not found.declined:
            self._recent.add(found.time_s, found.value, found.std)
        self._windows += 1
        self._declined += bool(found.declined)
        messages = self._apply(found, tracker)
        self.view = self._make_view(found)
        return messages

    def _watch_jumps(self, tracker: Tracker, told: Sequence[Message]) -> None:
        """What windows before a jump said is of another motor."""
        self._examines = tracker.examines_jump and tracker.jump_is_sudden
        for kind, _, data in told:
            if kind == JUMPED:
                self._changed_s = float(data["time_s"] or 0.0)
                self._recent.forget()

    def instead_of(self, name: str, filtered: Fused, now_s: float) -> Fused:
        """A parameter as the model has it, where it has proven itself and knows it better than the filter does: never
        a mean of the two.

        Args:
            filtered: what would be published without a model.
            now_s: device time.
        """
        told = self._recent.of(name, now_s) if self._refresh.mode == "trusted" else None
        if told is None or filtered.status == "fixed":
            return filtered
        value, std = told
        # The narrower limit of a filter keeps a start that still converges from being believed: here that is the
        # champion–challenger test.
        if not math.isfinite(value) or not std < LOST * abs(value):
            return filtered
        # While a jump is examined the filter says how far what it followed may have gone, and the windows do not.
        opened = self._examines and filtered.status == "tracking"
        if filtered.std is not None and name not in self._refresh.refuted and (filtered.std <= std or opened):
            return filtered
        last_s = self._recent.last_s
        return Fused(value, std, "tracking", _WHY_TRACKING, None if last_s is None else max(0.0, now_s - last_s))

    def _apply(self, found: RefreshEstimate, tracker: Tracker) -> list[Message]:
        # While a jump is examined the filter may be set back, and what entered it with it: only where it is wrong.
        if found.pseudo is None or (tracker.examines_jump and not found.pseudo.widen_std.any()):
            return []
        self._effect = _entered(tracker, found.pseudo)
        self._applied += 1
        self._applied_s = found.time_s
        if found.time_s - self._told_s < _TELL_EVERY_S:
            return []
        self._told_s = found.time_s
        moved = ", ".join(f"{n} by {100 * by:+.2g} %" for n, by in self._effect.items())
        data = {f"{n}_change_percent": round(100 * by, 3) for n, by in self._effect.items()}
        return [("refreshed", f"RF+GRNN estimate of the last window entered the filter: {moved}", data)]

    def _make_view(self, found: RefreshEstimate | None) -> EstimatorView:
        value = {} if found is None else found.value
        std = {} if found is None else found.std
        detail: dict[str, float | int | bool | str | None] = {
            "mode": self._refresh.mode,
            "learner": self.model.learner,
            "windows": self._windows,
            "windows_declined": self._declined,
            "window_end_s": None if found is None else found.time_s,
            "familiarity": None if found is None else finite_or_none(found.familiarity),
            "declined": (found.declined or None) if found is not None else None,
            "distance_sigma": None if found is None else finite_or_none(found.distance),
            "reason": (found.reason or None) if found is not None else "collecting the first window",
            "applied": self._applied,
            "last_applied_s": self._applied_s,
        }
        detail |= {f"effect_{n}_percent": finite_or_none(100 * by) for n, by in self._effect.items()}
        parameters = {n: (finite_or_none(value[n]), finite_or_none(std.get(n))) for n in value if n in self._published}
        return EstimatorView(parameters, detail)


def _entered(tracker: Tracker, pseudo: PseudoMeasurement) -> dict[str, float]:
    """Into the filter; by how much each of its parameters moved, as a share."""
    assert isinstance(tracker, PlantTracker)  # its estimate was compared with the model's
    before = _coordinates(tracker, pseudo.names)
    tracker.assimilate(Gaussian(pseudo.names, pseudo.mean, pseudo.covariance), pseudo.widen_std)
    after = _coordinates(tracker, pseudo.names)
    return {n: math.expm1(after[n] - before[n]) for n in pseudo.names}


def _estimate(tracker: Tracker) -> Gaussian | None:
    """The filter's own; None while it does not run."""
    return tracker.ekf.estimate() if tracker.ekf is not None and tracker.ekf.started else None


def _coordinates(tracker: Tracker, names: tuple[str, ...]) -> dict[str, float]:
    g = _estimate(tracker)
    assert g is not None  # it was compared with the model's
    return {n: float(g.mean[g.names.index(n)]) for n in names}
