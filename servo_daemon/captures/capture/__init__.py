"""A capture in memory, and what its columns are called."""
