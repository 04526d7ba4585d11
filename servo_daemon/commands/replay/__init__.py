"""`servo-daemon replay`, and the CSV it writes."""
