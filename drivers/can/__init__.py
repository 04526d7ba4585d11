"""CAN: the project's own frames and vendors', decoded, dated and put on a bus."""
