"""Events to addresses of the web, by POST."""
