"""Which signal of a file is which column: names, units, the signal map, the time base."""
