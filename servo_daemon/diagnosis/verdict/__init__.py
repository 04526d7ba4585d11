"""What is said of the model that was found, and what remains unexplained."""
