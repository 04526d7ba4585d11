"""Balances of armature and shaft, linear in the parameters, and recursive least squares on them."""
