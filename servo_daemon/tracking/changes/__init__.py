"""Parameters that jump: when, which, and what then."""
