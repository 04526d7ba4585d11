"""Text tables: their encoding, their dialect, what stands before the rows."""
