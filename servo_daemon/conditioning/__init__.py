"""Samples as the estimators take them: evenly laid rows, gaps and doubtful readings marked."""
