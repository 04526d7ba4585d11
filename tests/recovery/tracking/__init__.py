"""Recordings that a tracker is run on, and what is asked of its answers; `benchmarks.tracking` runs more of them."""
