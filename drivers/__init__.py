"""Drivers: everything that turns wire bytes, a file or a simulation into blocks of samples."""
