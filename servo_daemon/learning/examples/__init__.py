"""Simulated motors and their windows, from which is learned."""
