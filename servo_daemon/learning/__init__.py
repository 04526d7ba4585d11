"""The paper's third method: features of a window, screened by a random forest, and a GRNN that estimates from them.

Nothing of its own is imported here: scikit-learn takes a second to load, and only those who train or predict need it.
"""

from typing import Literal, get_args

#: Simulated motors of `train` without `--motors`, and of what `compare` trains on the spot: the first make the better
#: model, the second are enough for one capture.
DEFAULT_MOTORS, QUICK_MOTORS = 5000, 800

Learner = Literal["grnn", "forest", "boosting", "ridge", "neighbours"]
LEARNERS: tuple[Learner, ...] = get_args(Learner)
