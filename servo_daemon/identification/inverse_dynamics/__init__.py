"""Identification by the inverse dynamic model: filtered balances, least squares."""
