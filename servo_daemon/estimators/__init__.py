"""Estimators: pure objects with `reset`, `update(block)` and `estimate()`; no I/O, no clock."""
