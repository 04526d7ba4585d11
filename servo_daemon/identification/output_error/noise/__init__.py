"""Noise levels from the residuals: coloured residuals whitened, Fisher scoring."""
