"""`servo-daemon scan`: which drives are there."""
