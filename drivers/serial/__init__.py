"""The serial line: the project's binary frames and text lines."""
