"""The paper's third method: features of a window, screened by a random forest, and a GRNN that estimates from them.

Nothing is imported here: scikit-learn takes a second to load, and only those who train or predict need it.
"""

#: Simulated motors of `train` without `--motors`, and of what `compare` trains on the spot: the first make the better
#: model, the second are enough for one capture.
DEFAULT_MOTORS, QUICK_MOTORS = 5000, 800
