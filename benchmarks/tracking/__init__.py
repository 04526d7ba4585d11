"""Tracking on data of the independent generator: against the Cramér–Rao bound, under ageing, faults and wrong starts.

    .venv/bin/python -m benchmarks.tracking [PART …] [--runs N] [--seconds S] [--only TEXT] [--jobs N] [--out FILE]

bound, realistic   random-walk ageing against the Cramér–Rao bound, ideal and laboratory sensors (`bound.py`)
ageing             linear ageing (`ageing.py`)
scenarios          steps, quiet motion and faults: values, intervals, status, events, pictures (`scenarios.py`)
witness, steady    the regression beside the filter: fast and slow ageing, motors that do not change (`witness.py`)
published          the default simulated servo: is what is published true, and is it published (`published.py`)
false-steps        hidden effects, nothing changes: is a step invented (`false_steps.py`)
starts             a thousand wrong datasheets (`starts.py`)
long               10⁸ steps (`long.py`)
rivals, cost       filterpy, padasip, NumPy on the same samples; µs a sample, 32 drives (`rivals.py`, `cost.py`)

Each module's docstring says what it measures; those that tests run, too, are in `tests/recovery/tracking`.
Two cores are used; timings on a shared machine are noisy.
"""
