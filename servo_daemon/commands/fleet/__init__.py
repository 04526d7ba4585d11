"""`servo-daemon fleet`: many captures of many drives."""
