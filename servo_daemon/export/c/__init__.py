"""The estimator itself in C99 for the drive's own processor."""
