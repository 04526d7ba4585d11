"""A model's answer about the last windows, and whether it may be believed."""
