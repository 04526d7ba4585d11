"""What the simulation gets wrong: the missing torque and voltage, what they follow, and which effects could be it."""
