"""From examples to a model, in the foreground or beside a running daemon."""
