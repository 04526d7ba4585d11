"""What the commands answer, byte for byte: for changes of the code that must not change a number."""
