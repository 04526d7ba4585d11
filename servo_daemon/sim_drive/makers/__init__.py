"""Simulated drives of other makers: a motor under field-oriented control behind each maker's wire."""
