"""Recordings of the samples around events: which are kept, and where."""
