"""Drives whose voltage is a measurement, live."""
