"""`scenarios`: what happens to a drive, and what the daemon says of it.

The failure to be caught is a wrong value with a small std while `tracking`. Counted from the first sample on; after a
step of a parameter the first 5 s are left out: that is the time the daemon has to follow.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servo_daemon.samples import F64
from tests.recovery.generator import MOTORS
from tests.recovery.tracking.cases import CASES, Case
from tests.recovery.tracking.follow import Flags, Told, Track, nominal_of, sampled, tracked

#: How long after a step a value may still be on its way, s.
FOLLOW_S = 5.0
#: Longer than a sample of these recordings and its jitter, s.
SAMPLE_S = 2e-3
#: Beyond this many standard deviations a value contradicts its interval.
BEYOND = 3.0
#: Datasheet values are wrong by this factor.
NOMINAL = 1.3
#: A share of tracking time beyond `BEYOND`, or an error in standard deviations, that is named at the end.
NAMED_SHARE, NAMED_STDS = 0.02, 5.0

Job = tuple[str, str, float, int, Path | None]


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """One case judged; per parameter, shape (parameters,), NaN where nothing was published.

    Attributes:
        job: name, motor, seconds, seed, directory of the plots.
        motion, expect: the case's.
        names: of the parameters.
        final: error of the last value, relative.
        status: at the end.
        worst: largest |error| / std while tracking.
        beyond: share of the tracking time with an error beyond 3 std.
        square: mean of (error / std)² over the tracking time.
        share: share of the time tracking.
        recognised_s: from the step to the event that names it; None: never.
        after: error of the stepped parameter 5 s after the step, relative; NaN without a step.
        not_white_s: from the change to `innovation_white` false; None: never.
        white: share of the time after the change with `innovation_white` true.
        wrong_jumps: jumps that were reported and were none, as "parameter@time".
        events: in words.
    """

    job: Job
    motion: str
    expect: str
    names: tuple[str, ...]
    final: F64
    status: tuple[str, ...]
    worst: F64
    beyond: F64
    square: F64
    share: F64
    stepped: str
    recognised_s: float | None
    after: float
    not_white_s: float | None
    white: float
    wrong_jumps: tuple[str, ...]
    events: str


def run_case(job: Job) -> Row:
    """Generate, track, judge, plot."""
    name, motor, seconds, seed, plots = job
    case = CASES[name](MOTORS[motor], seconds, seed)
    track = tracked(case.recording, nominal_of(MOTORS[motor], NOMINAL), case.model)
    if plots is not None:
        from tests.recovery.tracking.plots import plot_case

        plot_case(plots, name, motor, case, track)
    return judge(job, case, track)


def judge(job: Job, case: Case, track: Track) -> Row:
    """Figures of one case."""
    truth, scale = truth_of(case, track), _scale_of(case, track)
    error = track.value - truth
    ratio = np.abs(error) / track.std
    counted = track.tracking & _counted(case, track)[:, None]
    late = track.time_s > (case.change_s or 0.0)
    jumps = [t for t in track.told if "jump" in t.kind or "step" in t.kind]
    named = [t for t in jumps if _is_of_the_step(t, case)]
    after = np.nan
    if case.stepped and case.change_s is not None:
        p, k = track.names.index(case.stepped), np.searchsorted(track.time_s, case.change_s + FOLLOW_S)
        after = float(abs(error[min(int(k), len(error) - 1), p]) / scale[-1, p])
    return Row(
        job=job,
        motion=case.motion,
        expect=case.expect,
        names=track.names,
        final=np.abs(error[-1]) / scale[-1],
        status=tuple(track.status[-1]),
        worst=np.max(np.where(counted, ratio, -np.inf), axis=0),
        beyond=_over(counted, ratio > BEYOND),
        square=_over(counted, np.square(ratio)),
        share=track.tracking.mean(axis=0),
        stepped=case.stepped,
        recognised_s=named[0].time_s - (case.change_s or 0.0) if named else None,
        after=after,
        not_white_s=_first(track.time_s[late & ~track.white], case.change_s or 0.0),
        white=float(track.white[late].mean()),
        wrong_jumps=tuple(f"{t.data.get('parameter')}@{t.time_s:.1f}" for t in jumps if t not in named),
        events=_in_words(track),
    )


def _over(counted: Flags, values: F64 | Flags) -> F64:
    """Mean of each parameter's values where they are counted, shape (parameters,); NaN where none is."""
    return np.array([np.mean(values[c, p]) if c.any() else np.nan for p, c in enumerate(counted.T)])


def truth_of(case: Case, track: Track) -> F64:
    """Shape (m, parameters)."""
    return sampled(case.truth, case.recording.truth.time_s, track.names, track.time_s)


def _scale_of(case: Case, track: Track) -> F64:
    scale = {**{name: np.abs(values) for name, values in case.truth.items()}, **case.scale}
    return sampled(scale, case.recording.truth.time_s, track.names, track.time_s)


def _counted(case: Case, track: Track) -> Flags:
    if not case.stepped or case.change_s is None:
        return np.ones(len(track.time_s), dtype=bool)
    # (A tick that ends with the step may hold its first sample.)
    return np.asarray((track.time_s < case.change_s - SAMPLE_S) | (track.time_s > case.change_s + FOLLOW_S))


def _is_of_the_step(told: Told, case: Case) -> bool:
    """The jump that was reported is the case's step, or a part of it."""
    if not case.stepped or case.change_s is None or told.data.get("parameter") != case.stepped:
        return False
    return case.change_s <= told.time_s <= case.change_s + FOLLOW_S


def _first(times_s: F64, begin_s: float) -> float | None:
    return float(times_s[0] - begin_s) if len(times_s) else None


def _in_words(track: Track) -> str:
    """Kinds with the parameter they name and their times; what repeats is counted."""
    said: dict[str, list[float]] = {}
    for t in track.told:
        parameter = t.data.get("parameter")
        said.setdefault(f"{t.kind} {parameter}" if parameter else t.kind, []).append(t.time_s)
    parts = [
        f"{what}@{times[0]:.1f}" if len(times) == 1 else f"{len(times)}×{what}@{times[0]:.1f}…{times[-1]:.1f}"
        for what, times in said.items()
    ]
    return ", ".join(parts)


def report_scenarios(runs: int, seconds: float, only: str, plots: Path | None) -> None:
    """Prints a row for each case, motor and run; `plots`: a picture of each case's first motor and run."""
    print(f"\nScenarios: {seconds:.0f} s at 1 kHz, datasheet {NOMINAL:g} × the truth, {runs} run(s) each")
    print("per parameter: error of the last value in % (TL: of the rated torque) and status then (Tracking, Unexcited,")
    print("Estimating, …); largest |error|/std while tracking; % of the tracking time beyond 3 std; % of time tracking")
    print("then: time until the step was named, error 5 s after it; innovations white, and first not white after")
    jobs = [
        (name, motor, seconds, 100 * run + 23, plots if run == 0 and motor == "paper" else None)
        for name in CASES
        if only in name
        for motor in MOTORS
        for run in range(runs)
    ]
    rows = []
    with ProcessPoolExecutor(2) as pool:
        for row in pool.map(run_case, jobs):
            if row.job[1] == "paper" and row.job[3] == 23:
                print(f"\n{row.job[0]}  ({row.motion})")
            print(as_text(row), flush=True)
            rows.append(row)
    _summary(rows)


def as_text(row: Row) -> str:
    """One line."""
    cells = "".join(
        f"  {name:2}{_percent(row.final[p])}{row.status[p][0].upper()}{_number(row.worst[p])}"
        f"{_percent(row.beyond[p], 0)}{100 * row.share[p]:4.0f}"
        for p, name in enumerate(row.names)
    )
    step = ""
    if row.stepped:
        when = "never named" if row.recognised_s is None else f"named after {row.recognised_s:.1f} s"
        step = f"{row.stepped} {when}, {100 * row.after:.1f} % off at 5 s; "
    first = "" if row.not_white_s is None else f", not white after {row.not_white_s:.1f} s"
    return f"  {row.job[1]:6}{cells}  | {step}white {100 * row.white:.0f} %{first} | {row.events}"


def _percent(value: float, digits: int = 2) -> str:
    width = 7 if digits else 4
    if not np.isfinite(value):
        return f"{'–':>{width}}"
    return f"{min(100 * value, 9999):{width}.{digits if 100 * value < 100 else 0}f}"


def _number(value: float) -> str:
    return f"{min(value, 9999.0):7.1f}" if np.isfinite(value) else f"{'–':>7}"


def _calibration(rows: list[Row]) -> None:
    """How large the errors are beside what is said of them: a few draws may be far off by chance, all of them not."""
    print("rms of error/std over the tracking time, all motors and runs (an offset that std allows for may make it 1):")
    for name in dict.fromkeys(row.job[0] for row in rows):
        of_case = [row for row in rows if row.job[0] == name]
        squares = np.array([row.square for row in of_case])
        cells = [
            f"{p} {np.sqrt(np.mean(x[np.isfinite(x)])):.2f}" if np.isfinite(x).any() else f"{p} –"
            for p, x in zip(of_case[0].names, squares.T, strict=True)
        ]
        print(f"  {name}: {'  '.join(cells)}")


def _summary(rows: list[Row]) -> None:
    """The wrong values with a small std, what was asked and not seen, and what was seen and was not."""
    print(
        f"\nbeyond 3 std for more than {100 * NAMED_SHARE:.0f} % of the tracking time, or once beyond {NAMED_STDS:g}:"
    )
    for row in rows:
        bad = [
            f"{name} {_number(row.worst[p]).strip()} σ, {100 * row.beyond[p]:.0f} % of the time"
            for p, name in enumerate(row.names)
            if row.beyond[p] > NAMED_SHARE or row.worst[p] > NAMED_STDS
        ]
        if bad:
            print(f"  {row.job[0]}, {row.job[1]}: {'; '.join(bad)}")
    _calibration(rows)
    print("steps not named within 2 s, or more than 3 % off after 5 s; mismatch that was not seen:")
    for row in rows:
        late = row.stepped and not (row.recognised_s is not None and 0 <= row.recognised_s <= 2.0 and row.after < 0.03)
        if late or (row.expect == "not white" and row.not_white_s is None):
            print(f"  {row.job[0]}, {row.job[1]}: {as_text(row).split('|')[1].strip()}")
    print("jumps that were reported and were none:")
    for row in rows:
        if row.wrong_jumps:
            more = f" and {len(row.wrong_jumps) - 6} more" if len(row.wrong_jumps) > 6 else ""
            print(f"  {row.job[0]}, {row.job[1]}: {', '.join(row.wrong_jumps[:6])}{more}")
