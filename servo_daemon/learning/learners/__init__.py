"""The learners: forest, generalised regression network, their screening, intervals and familiarity."""
