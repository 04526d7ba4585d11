"""Detection of steps of parameters: when, which, and what is done then."""
