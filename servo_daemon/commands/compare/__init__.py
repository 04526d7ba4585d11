"""`servo-daemon compare`: document, text and report."""
