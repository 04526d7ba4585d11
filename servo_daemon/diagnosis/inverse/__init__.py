"""The same questions put to the inverse dynamic model."""
