"""CANopen drives with the profile CiA 402: their PDOs listened to, or their objects read by SDO."""
