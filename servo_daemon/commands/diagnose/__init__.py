"""`servo-daemon diagnose`: document, text and report."""
