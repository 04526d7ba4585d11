"""Whether a parameter may be published: information, agreement with the regression, history."""
