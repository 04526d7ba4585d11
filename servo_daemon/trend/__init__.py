"""Ageing: how a parameter has changed over months and years, and when it will reach its limit. Arrays in, records out."""
