"""The whole diagnosis of captures: baseline, search, verdict, extended model, what it gains, what is left."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from threadpoolctl import threadpool_limits

from servo_daemon import __version__
from servo_daemon.captures import Capture, in_canonical_order
from servo_daemon.diagnosis.inverse.inverse import found_by_balance
from servo_daemon.diagnosis.screening.dependence import dependences, is_large
from servo_daemon.diagnosis.search.effort import Effort, Journal
from servo_daemon.diagnosis.search.select import Selection, select
from servo_daemon.diagnosis.trial.data import Data
from servo_daemon.diagnosis.trial.full_data_fit import FullDataFits, fit_full_data
from servo_daemon.diagnosis.trial.model_discrepancy import longest_missing
from servo_daemon.diagnosis.trial.noise_floor import errs_beyond_noise
from servo_daemon.diagnosis.trial.split import segment_length_s
from servo_daemon.diagnosis.trial.trial import first_trial
from servo_daemon.diagnosis.verdict.adequacy import Believed, believed
from servo_daemon.diagnosis.verdict.differences import differences
from servo_daemon.diagnosis.verdict.gain import gain, measured_on
from servo_daemon.diagnosis.verdict.predictions import found_by_predictions
from servo_daemon.diagnosis.verdict.result import CandidateScore, Diagnosis, Finding
from servo_daemon.errors import ServoDaemonError
from servo_daemon.identification.output_error import FitOptions, OutputErrorFit, Recording
from servo_daemon.identification.output_error.fit import published
from servo_daemon.identification.procedure.validate import validated

#: Told how far it is, 0 .. 1, and what is being done.
Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class DiagnoseOptions:
    """Settings of a diagnosis.

    Attributes:
        baseline: effects of the model that is doubted.
        nominal: start values, natural units.
        fixed: parameters held in every model.
        adapt: as for `validated`; None: not.
        workers: threads that fit.
        budget_s: processor time after which nothing more is tried, and the best so far is the answer; None: no limit.
        journal: a file that keeps what has been fitted, for a diagnosis of the same captures to go on from.
    """

    baseline: tuple[str, ...] = ()
    nominal: Mapping[str, float] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    adapt: float | None = None
    workers: int = 2
    budget_s: float | None = None
    journal: Path | None = None


def diagnose(
    captures: Sequence[Capture],
    validation: Sequence[Capture] = (),
    options: DiagnoseOptions | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find what the simulation of these captures lacks.

    Raises:
        BadInputError: captures that cannot be used, alone or together.
        NumericalError: the baseline cannot be simulated over them.
    """
    # One thread for the linear algebra: matrices are small, the search has threads of its own, and the rounding of a
    # verdict near the edge must not depend on the machine's cores.
    with threadpool_limits(limits=1):
        return _diagnose(in_canonical_order(captures), validation, options or DiagnoseOptions(), progress or _unheard)


def _diagnose(
    captures: Sequence[Capture], validation: Sequence[Capture], options: DiagnoseOptions, progress: Progress
) -> Diagnosis:
    began = time.perf_counter()
    recordings = tuple(Recording(str(c.path), c.block()) for c in captures)
    journal = None if options.journal is None else Journal(options.journal, _fingerprint(recordings, options))
    effort = Effort(options.workers, options.budget_s, journal)
    progress(0.0, "fitting the baseline")
    data = Data.of(recordings, options.fixed, options.baseline, segment_length_s(recordings))
    base = first_trial(data, options.baseline, options.nominal)
    full_fits = FullDataFits(data)
    selection = select(data, base, _within(progress, 0.1, 0.8), full_fits.of, effort)
    progress(0.8, "whether the names can be believed")
    belief = believed(selection, full_fits)
    every = data.full
    baseline = fit_full_data(every, base, FullDataFits(every) if belief.extended is None else None)
    diagnosis = _by_free_runs(captures, every, belief, baseline, _within(progress, 0.88, 1.0))
    if not diagnosis.effects and effort.allows("predictions of each sample and the balance"):
        with suppress(ServoDaemonError):  # then the free runs have the last word
            diagnosis = _otherwise(diagnosis, data, belief.selection, options.nominal, full_fits)
    scores = tuple(validated(c, baseline, diagnosis.extended, recordings, options.adapt) for c in validation)
    held = FitOptions(fixed=options.fixed, segment_s=data.split.segment_s)
    shown = published(diagnosis.baseline, every.recordings, held)
    return replace(
        diagnosis, baseline=shown, validation=scores, seconds=time.perf_counter() - began, unfinished=effort.unfinished
    )


def _fingerprint(recordings: Sequence[Recording], options: DiagnoseOptions) -> str:
    """Of all that a fit depends on: samples, the model that is doubted, what is held, this version."""
    digest = hashlib.sha256(repr((__version__, options.baseline, sorted(options.fixed.items()))).encode())
    for recording in recordings:
        for name in ("time_s", *recording.block.channels):
            digest.update(name.encode() + getattr(recording.block, name).tobytes())
    return digest.hexdigest()


def _by_free_runs(
    captures: Sequence[Capture], every: Data, belief: Believed, baseline: OutputErrorFit, progress: Progress
) -> Diagnosis:
    """What the search came to, scored; `validation` and `seconds` are yet to come.

    Args:
        every: with nothing held out.
    """
    progress(0.0, "scoring on what was held out")
    gained = gain(belief)
    selection, final = belief.selection, belief.extended or baseline
    progress(0.33, "what is left")
    before = longest_missing(every, baseline)
    depends, remains = belief.depends_on, bool(belief.depends_on)
    if belief.extended is None and not baseline.white:
        depends = dependences(baseline, before)
        remains = bool(depends) or is_large(before) or errs_beyond_noise(every, baseline, selection.base, before)
    progress(0.58, "what differs between the captures")
    held = {**every.fixed, **selection.chosen.held}
    spreads, own_models = differences(every.recordings, final, held, selection.data.split.segment_s)
    return Diagnosis(
        captures=tuple(captures),
        verdict="found" if gained.effects else "unexplained" if remains else "none",
        effects=gained.effects,
        baseline=baseline,
        extended=belief.extended,
        baseline_score=gained.baseline_score,
        extended_score=gained.extended_score,
        noise_floor=gained.floor,
        error_removed=gained.removed,
        ci95=gained.ci95,
        measured_on=measured_on(selection.data.split),
        candidates=_candidates(selection),
        before=before,
        after=belief.missing,
        white=final.white,
        depends_on=depends,
        differences=spreads,
        own_models=own_models,
        validation=(),
        seconds=0.0,
    )


def _otherwise(
    d: Diagnosis, data: Data, selection: Selection, nominal: Mapping[str, float], full_fits: FullDataFits
) -> Diagnosis:
    """Where free runs name nothing: what predictions show, else what the balance does."""
    found = found_by_predictions(data, selection, d.candidates, full_fits) or found_by_balance(
        data, d.baseline, selection.base, nominal
    )
    return d if found is None else _named(d, found)


def _named(d: Diagnosis, found: Finding) -> Diagnosis:
    """The diagnosis with what another judge than free runs has named."""
    return replace(
        d,
        **{f.name: getattr(found, f.name) for f in fields(found) if f.name != "before"},
        before=found.before or d.before,
        verdict="found",
        white=found.extended.white,
        depends_on=() if found.extended.white else dependences(found.extended, found.after),
        differences=(),
        own_models=(),
    )


def _within(progress: Progress, begin: float, end: float) -> Progress:
    """A part of the whole, as its own progress."""
    return lambda share, step: progress(begin + (end - begin) * min(share, 1.0), step)


def _unheard(_share: float, _step: str) -> None:
    """Nobody asked how far it is."""


def _candidates(selection: Selection) -> tuple[CandidateScore, ...]:
    out, beside = [], selection.base.effects
    for candidates in selection.rounds:
        taken = next((c for c in candidates if c.taken), None)
        out += [CandidateScore(c.name, beside, c.trial.choice.nrmse, c.against.delta_bic, c.taken) for c in candidates]
        beside = taken.trial.effects if taken is not None else beside
    return tuple(out)
