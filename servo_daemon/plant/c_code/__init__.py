"""The text of the C code around a generated step."""
