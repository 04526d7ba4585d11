"""A model fitted on one part of the data and scored on another; two such models compared."""
