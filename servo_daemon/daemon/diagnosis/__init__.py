"""Diagnoses beside the running daemon: asked for, run in a process of their own, answered."""
