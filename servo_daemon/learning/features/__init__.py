"""A window of samples as numbers: from its signals, and from the balances' regressions."""
