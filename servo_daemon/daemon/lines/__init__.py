"""The lines to the drives: what arrives on them, taken off by threads and queued."""
