"""What was learned: predictions with their intervals, and the file it is kept in."""
