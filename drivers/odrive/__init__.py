"""ODrive: CANSimple frames of firmware 0.5 and 0.6, and the text protocol of 0.5."""
