"""Ageing: how a parameter changes over months and years, and when it reaches its limit. Arrays in, records out."""
