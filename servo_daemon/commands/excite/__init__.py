"""`servo-daemon excite`: the plan and its outputs."""
