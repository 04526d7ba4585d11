"""Simulated drives that speak the real wires on a pseudo-terminal."""
