"""The live estimator of one drive: samples in, parameters with their standard deviations out; no clock, no I/O."""
