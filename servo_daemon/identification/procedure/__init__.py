"""Captures in, fitted and validated model out."""
