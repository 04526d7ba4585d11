"""The free run of a model and its residuals, with their derivatives."""
