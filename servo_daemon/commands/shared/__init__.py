"""What the commands have in common: arguments, folders, units and symbols."""
