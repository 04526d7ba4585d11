"""`servo-daemon run`: the daemon, its server, its reload."""
