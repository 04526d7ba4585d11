"""Which known effects, and which signals, the missing inputs follow."""
