"""servo-daemon: online, self-explaining parameter estimation for a live DC servo drive."""

__version__ = "0.1.0"
