"""Spoilt inputs for every decoder and reader, from one command: `python -m tests.fuzz --inputs 1000000`."""
