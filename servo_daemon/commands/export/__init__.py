"""`servo-daemon export`: what it is given, and what it writes."""
