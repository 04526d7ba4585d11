"""What the API reads of a drive: its snapshot, view, history, metrics and what is known for tuning."""
