"""Drives that answer when they are asked: one base for all of them."""
