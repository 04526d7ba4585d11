"""Simulated drives that speak the wires of the makes that people own."""
