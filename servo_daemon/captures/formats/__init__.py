"""One file for each format of captures."""
