"""Servos in a chain on one half-duplex line: Dynamixel X and Feetech STS."""
