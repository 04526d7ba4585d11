"""Effects tried one after another, as long as each earns its place."""
