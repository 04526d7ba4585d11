"""`servo-daemon fit`: inputs, document, text and report."""
