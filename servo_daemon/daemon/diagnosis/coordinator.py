"""One drive's diagnosis: when it begins, how it stands, what it says, and what is done about it."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

from drivers.base import DriveInfo
from servo_daemon import __version__
from servo_daemon.config import DriveConfig
from servo_daemon.daemon.diagnosis.files import capture_metadata, drive_toml, load_record, save_record, start_values
from servo_daemon.daemon.diagnosis.runner import DiagnosisRunner, Job
from servo_daemon.errors import BusyError, RefusedError, ServoDaemonError
from servo_daemon.pipeline.diagnosis_watch import MismatchWatch
from servo_daemon.pipeline.event_log import EventLog
from servo_daemon.pipeline.model_change import ModelRequest, adopted_effects, checked_request
from servo_daemon.pipeline.ring import SampleRing
from servo_daemon.published.diagnosis_state import Adoption, Diagnosis, DiagnosisView, Trigger
from servo_daemon.published.snapshot import Estimate
from servo_daemon.published.view import ModelChange
from servo_daemon.signal_meaning import SignalMeaning

#: A recording that is shorter than this says too little, s.
LEAST_S: Final = 10.0


class Drive(Protocol):
    """What it must know of its drive."""

    @property
    def active(self) -> DriveConfig:
        """The drive's configuration, with the model as it is now."""

    @property
    def info(self) -> DriveInfo:
        """What the driver knows of its device."""

    @property
    def meaning(self) -> SignalMeaning:
        """What the drive's signals mean."""

    @property
    def estimate(self) -> Estimate | None:
        """The last estimate."""

    def change_model(self, request: ModelRequest) -> Future[ModelChange]:
        """Have a model exchanged."""


class DiagnosisCoordinator:
    """Starts one drive's diagnoses and acts on what they find. `watch` belongs to the worker; everything else may be
    called from any thread.

    Args:
        runner: the daemon's.
    """

    def __init__(self, drive: Drive, ring: SampleRing, events: EventLog, runner: DiagnosisRunner) -> None:
        self._drive, self._ring, self._events, self._runner = drive, ring, events, runner
        self._lock = threading.Lock()
        self._watch = MismatchWatch(ring.seconds)
        self._diagnosis = Diagnosis()
        if runner.home is not None:
            self._diagnosis = load_record(runner.folder(drive.active.name)) or self._diagnosis
        self._origin_s: float | None = None  # device time of the recording's first sample
        self._counts: Counter[str] = Counter()
        self._adopting = False

    def view(self) -> DiagnosisView:
        """The diagnosis as it stands now."""
        reason = self._why_not()
        return DiagnosisView(self._diagnosis, self.adoption(), reason is None, reason, dict(self._counts))

    def request(self) -> Diagnosis:
        """Begin one now.

        Raises:
            RefusedError: the configuration does not allow it.
            BusyError: one is running, or there are too few samples yet.
        """
        estimation = self._drive.active.estimation
        if estimation.diagnose == "never" or estimation.ring_s <= 0:
            raise RefusedError(self._why_not() or "")
        why = self._why_not()
        if why is not None:
            raise BusyError(why)
        return self._begin("request")

    def watch(self, estimate: Estimate) -> None:
        """After each estimate: begin one if the model has not explained the data for long."""
        if self._drive.active.estimation.diagnose != "on_mismatch":
            return
        if self._watch.due(estimate, self._ring.span_s, time.monotonic()) and self._why_not() is None:
            with contextlib.suppress(BusyError):  # another drive was faster; the next estimate asks again
                self._begin("mismatch")

    def model_changed(self) -> None:
        """What was found was of another model. One that was adopted without being asked is given its time: two that
        each find the other missing would take turns for ever."""
        self._watch.forget()
        if self._adopting:
            self._adopting = False
            self._watch.ended(("adopted",), time.monotonic())

    def adoption(self) -> Adoption:
        """Whether what was found can become the model now."""
        d = self._diagnosis
        if d.status != "done" or not d.effects or d.model is None:
            return Adoption(False, None, None)
        try:
            effects = adopted_effects(d.model, d.effects)
            checked_request(effects, {})
        except ServoDaemonError as error:
            return Adoption(False, None, str(error))
        now = self._drive.active
        if now.model == effects:
            return Adoption(False, effects, "the drive has this model")
        if now.model != d.model:
            return Adoption(False, effects, "the drive's model has changed since")
        if now.estimation.adopt == "never":
            return Adoption(False, effects, 'the configuration says adopt = "never"')
        return Adoption(True, effects)

    def completed(self, request: ModelRequest) -> ModelRequest:
        """A request for the model that was found, with the values that were found for what it does not give itself."""
        adoption, result = self.adoption(), self._diagnosis.result
        if result is None or not adoption.allowed or set(request.effects) != set(adoption.effects or ()):
            return request
        start = {**start_values(result, request.effects), **request.start}
        return replace(checked_request(request.effects, start), origin_s=self._origin_s, by="diagnosis")

    # -- the runner's thread ---------------------------------------------------------------------------------

    def on_progress(self, progress: float | None, step: str | None) -> None:
        now = self._diagnosis
        known = now.progress if progress is None else progress
        self._diagnosis = replace(now, progress=known, step=now.step if step is None else step)

    def on_result(self, document: Mapping[str, Any], report: Path | None) -> None:
        now = replace(self._diagnosis, status="done", finished=time.time(), progress=1.0, step=None)
        done = replace(now, result=document, report=report)
        if self._runner.home is not None:
            save_record(self._runner.folder(self._drive.active.name), done)
        verdict = str(done.verdict)
        self._counts[verdict] += 1
        self._watch.ended((verdict, *sorted(done.effects)), time.monotonic())
        text, data = _told(done)
        self._events.add("diagnosis_done", text, data)
        self._diagnosis = done  # last: who sees the verdict finds its event and its count
        if self._drive.active.estimation.adopt == "auto" and self.adoption().allowed:
            self._adopt()

    def on_failure(self, reason: str) -> None:
        self._counts["failed"] += 1
        self._watch.ended(("failed",), time.monotonic())
        self._events.add("diagnosis_failed", f"the diagnosis failed: {reason}")
        self._diagnosis = replace(self._diagnosis, status="failed", finished=time.time(), step=None, reason=reason)

    # -- helpers ---------------------------------------------------------------------------------------------

    def _adopt(self) -> None:
        effects = self.adoption().effects or ()
        self._adopting = True
        try:
            self._drive.change_model(self.completed(checked_request(effects, {})))
            self._events.add("diagnosis_adopted", "what was found is adopted: " + ", ".join(self._diagnosis.effects))
        except ServoDaemonError as error:
            self._adopting = False
            self._events.add("diagnosis_failed", f"what was found cannot be adopted: {error}")

    def _why_not(self) -> str | None:
        """Why none can be begun by request now, in words."""
        estimation = self._drive.active.estimation
        if estimation.diagnose == "never":
            return 'the configuration says diagnose = "never"'
        if estimation.ring_s <= 0:
            return "the configuration keeps no samples (ring_s = 0)"
        if self._diagnosis.status == "running":
            return "a diagnosis of this drive is running"
        if self._runner.busy_with is not None:
            return f"a diagnosis of drive {self._runner.busy_with} is running; there is one at a time"
        least = min(LEAST_S, 0.9 * estimation.ring_s)
        if self._ring.span_s < least:
            return f"{self._ring.span_s:.1f} s of samples are there, {least:g} s are needed"
        return None

    def _begin(self, trigger: Trigger) -> Diagnosis:
        """Raises: BusyError: another drive was faster."""
        with self._lock:
            if self._diagnosis.status == "running":
                raise BusyError("a diagnosis of this drive is running")
            blocks, active = self._ring.blocks(), self._drive.active
            if not blocks:
                raise BusyError("no samples are there")
            last = self._diagnosis
            goes_on = last.unfinished and trigger == "request" and last.model == active.model
            span_s = float(blocks[-1].time_s[-1]) - float(blocks[0].time_s[0])
            samples, span_s = (last.samples, last.span_s) if goes_on else (sum(map(len, blocks)), span_s)
            metadata = capture_metadata(active, self._drive.info, __version__, self._drive.meaning)
            job = Job(
                active.name,
                self._runner.folder(active.name),
                blocks,
                metadata,
                drive_toml(active, self._drive.estimate),
                goes_on,
            )
            before, self._diagnosis = last, Diagnosis(
                "running", trigger, active.model, time.time(), None, samples, span_s, 0.0, "starting"
            )  # fmt: skip
            begun = self._diagnosis
            try:
                self._runner.start(job, self)
            except BusyError:
                self._diagnosis = before
                raise
            if not goes_on:
                self._origin_s = float(blocks[0].time_s[0])
        why = "by request" if trigger == "request" else "because the model does not explain the data"
        what = "that was not finished goes on" if goes_on else f"of the last {span_s:.0f} s has begun"
        text = f"a diagnosis {what} {why}"
        self._events.add("diagnosis_started", text, {"trigger": trigger, "span_s": round(span_s, 3)})
        return begun


def _told(done: Diagnosis) -> tuple[str, Mapping[str, float | int | str | None]]:
    """The verdict in words, and its numbers."""
    text, data = _verdict_told(done)
    return (text + "; not finished: its processor time was spent" if done.unfinished else text), data


def _verdict_told(done: Diagnosis) -> tuple[str, Mapping[str, float | int | str | None]]:
    result = done.result or {}
    gain = (result.get("gain") or {}).get("error_removed")
    share = float(gain) if isinstance(gain, int | float) else None
    data: dict[str, float | int | str | None] = {"verdict": done.verdict, "effects": ",".join(done.effects)}
    if done.verdict == "found":
        removed = "" if share is None else f"; with it {100 * share:.0f} % of the error that can go is gone"
        text = f"the data hold what the model lacks: {', '.join(done.effects)}{removed}"
        return text, {**data, "error_removed": share}
    remaining = result.get("remaining") or {}
    if done.verdict == "none":
        white = remaining.get("white", True)
        how = "the model explains the recording to its noise" if white else "no other explains the recording better"
        return f"nothing is missing: {how}", data
    follows = remaining.get("depends_on") or []
    on = ", ".join(str(f.get("on", f) if isinstance(f, dict) else f) for f in follows)
    return "the model lacks something that has no name here" + (f"; it follows {on}" if on else ""), data
