"""The motor as a unit for co-simulation."""
