"""What was identified, as files that other tools load."""
