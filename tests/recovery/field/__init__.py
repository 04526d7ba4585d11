"""Captures of the independent generator as people's loggers write them, and what the program makes of the files."""
