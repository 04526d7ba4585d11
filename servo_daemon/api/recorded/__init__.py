"""Samples: kept captures as files, and the last ones as a scope shows them."""
