"""`servo-daemon commission`: moves the motor, small first, until its parameters are known."""
