"""One daemon, eight drives at 1 kHz, and everything that can go wrong around it, in turn."""
