"""Threads, processes, files, signals: what keeps the drives' pipelines running."""
