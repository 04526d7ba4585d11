"""Tracking on data of the independent generator: against the Cramér–Rao bound, under ageing, faults and wrong starts.

    .venv/bin/python -m benchmarks.tracking [bound] [realistic] [ageing] [scenarios] [starts] [long] [rivals]
        [--runs N] [--seconds S] [--only TEXT] [--plots DIR]

Each part is a module of that name; its docstring says what it measures. Both cores are used; timings on a shared
machine are noisy.
"""

from .ageing import ageing_run
from .bound import bound_run
from .follow import NAMES, Track, tracked

__all__ = ["NAMES", "Track", "ageing_run", "bound_run", "tracked"]
