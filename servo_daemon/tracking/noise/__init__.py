"""How large sensor and process noise are, from the data."""
