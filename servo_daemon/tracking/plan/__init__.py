"""What is to be estimated, from which signals, with which settings."""
