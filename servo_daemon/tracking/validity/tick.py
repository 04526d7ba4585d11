"""What the tracker knows after a tick beside the estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from servo_daemon.regression.sampling import Sampling, settles_between


@dataclass(frozen=True, slots=True)
class Tick:
    """Facts of a tick beside the estimates.

    Attributes:
        settled: the filter has run for long enough for its noise levels to be no guesses, and its first samples have
            been re-linearised where it started from little.
        open: a jump is being looked for.
        explained: ticks that the noise does not explain are the exception.
        white: innovations are.
        inductance_std: 1 σ of ln L that the steps of the recorded voltage leave open; looked up when the regressions
            have been worked off.
        sampling: noise and what else integrals over samples are off by.
        end_s: device time.
    """

    settled: bool
    open: bool
    explained: bool
    white: bool
    inductance_std: float
    sampling: Sampling
    end_s: float

    def is_blind(self, name: str, values: Mapping[str, float]) -> bool:
        """Whether nothing but the filter's model sees a parameter: the inductance of a winding that settles between two
        samples."""
        return name == "L" and settles_between(values["R"], values["L"], self.sampling.period_s)
