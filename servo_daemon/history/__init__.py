"""The store of what was published: years of it, in levels that grow coarser with age."""
