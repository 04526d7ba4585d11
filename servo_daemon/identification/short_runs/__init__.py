"""A load behind a gap, fitted to short free runs of which each begins in a state of its own.

Behind a gap a free run is no smooth function of the parameters: teeth that meet a moment later meet at another speed,
and what follows is another motion. Where the load is when a run begins decides it, and no descent finds that: it lies
anywhere in the gap. Here the runs are so short that a load meets its teeth about once, its place and speed at the
beginning of each are searched for all over the gap, and the parameters are moved with the states following (variable
projection: Golub & Pereyra, *SIAM J. Numer. Anal.* 10, 1973; Kaufman, *BIT* 15, 1975).
"""

from servo_daemon.identification.short_runs.fit import begun_short_runs, fit_short_runs
from servo_daemon.identification.short_runs.informative import RunSource, with_all_inertia
from servo_daemon.identification.short_runs.initial_states import (
    found_states_std,
    has_found_states,
    short_runs_with_found_states,
    with_found_states,
)
from servo_daemon.identification.short_runs.published import by_short_runs
from servo_daemon.identification.short_runs.runs import can_be_fitted
from servo_daemon.identification.short_runs.search import ShortRunFit

__all__ = [
    "RunSource",
    "ShortRunFit",
    "begun_short_runs",
    "by_short_runs",
    "can_be_fitted",
    "fit_short_runs",
    "found_states_std",
    "has_found_states",
    "short_runs_with_found_states",
    "with_all_inertia",
    "with_found_states",
]
