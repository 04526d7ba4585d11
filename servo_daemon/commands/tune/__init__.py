"""`servo-daemon tune`: the motor as it is, and the gains for it."""
