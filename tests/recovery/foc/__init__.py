"""A brushless motor under field-oriented control, written for the tests alone: it shares nothing with the plant."""
