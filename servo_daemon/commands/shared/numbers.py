"""Types of flags that are numbers."""

from __future__ import annotations

import argparse
import math


def positive(text: str) -> float:
    """A finite number greater than zero.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number greater than zero, not {text}")
    return value
