"""A tick's samples on their way through the filter, and how large the signals are."""
