"""What the simulation gets wrong: the unmodelled torque and voltage, what they follow, and which effects could be
it."""
