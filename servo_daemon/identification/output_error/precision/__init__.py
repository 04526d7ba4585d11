"""How well the data determine each parameter: information, covariance, null directions."""
