"""What the innovations say: noise of channels, input and unmodelled torque, and whether they are white."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servo_daemon.estimators import noise
from servo_daemon.estimators.ekf import Innovations, NoiseLevels
from servo_daemon.estimators.noise import ChannelNoise, ProcessNoise, Whiteness
from servo_daemon.samples import F64

#: Fewest innovations in a tick from which a correlation can be taken.
_FEWEST_FOR_CORRELATION = 8
#: Whiteness: leaves at the second value, returns at the first.
_WHITE_IN, _WHITE_OUT = 0.15, 0.25
#: White, but only because process noise was raised by this factor: not white.
_UNEXPLAINED = 10.0


class InnovationWatch:
    """Fed the innovations of each tick.

    Args:
        measured: the filter's channels; the last one shows the motion.

    Attributes:
        whiteness: per channel, once it has been seen.
        white: with hysteresis: innovations are uncorrelated, and not only because process noise was raised.
        gated: samples that were weighted down as outliers.
    """

    def __init__(self, measured: tuple[str, ...]) -> None:
        self._measured = measured
        self._channel: dict[str, ChannelNoise] = {}
        self._process: dict[str, ProcessNoise] = {}
        self.whiteness: dict[str, Whiteness] = {}
        self.white = True
        self.gated = 0

    def start(self, channels: Mapping[str, ChannelNoise]) -> None:
        """Begin with these levels; what was found about the model before is forgotten."""
        self._channel = dict(channels)
        self._process = {}

    def levels(self, input_rms: float, input_lsb: float | None, torque_Nm: float) -> NoiseLevels:
        """What the filter is to work with.

        Args:
            input_rms, input_lsb: of the held input, in its unit.
            torque_Nm: typical motor torque.
        """
        of_input, of_torque = self._of("current_A"), self._of(self._measured[-1])
        return NoiseLevels(
            noise.input_variance(input_rms, input_lsb) * of_input.factor,
            noise.torque_intensity(torque_Nm) * of_torque.factor,
            tuple(self._channel[c].var for c in self._measured),
        )

    def after(self, rows: F64, innovations: Innovations, duration_s: float) -> float:
        """Take a tick's rows (see `EkfLayout`) and innovations; returns the largest mean of ν²/s of a channel."""
        worst = 0.0
        for k, name in enumerate(self._measured):
            # A standing encoder repeats itself: what it says then is no sample of any noise.
            chosen = rows[:, 5 + 3 * k] * (rows[:, 6 + 3 * k] == 1.0) > 0
            nu, s = innovations.innovation[chosen, k], innovations.variance[chosen, k]
            if len(nu) == 0:
                continue
            worst = max(worst, float(np.mean(np.square(nu) / s)))
            if len(nu) >= _FEWEST_FOR_CORRELATION:
                correlation, nis = noise.correlation_and_nis(nu, s)
                self._process[name] = self._of(name).after(correlation, nis, follow=name == "current_A")
            self.whiteness[name] = self.whiteness.get(name, Whiteness()).after(nu, s, duration_s)
            self._channel[name] = noise.adapted(self._channel[name], nu, s, duration_s)
        self.gated += int(innovations.gated.sum())
        self._judge()
        return worst

    def _of(self, name: str) -> ProcessNoise:
        return self._process.get(name, ProcessNoise())

    def _judge(self) -> None:
        if not self.whiteness:
            return
        correlation = max(abs(w.correlation) for w in self.whiteness.values())
        unexplained = max((n.factor for n in self._process.values()), default=1.0)
        out, limit = (_WHITE_OUT, 2 * _UNEXPLAINED) if self.white else (_WHITE_IN, _UNEXPLAINED)
        self.white = bool(correlation < out and unexplained < limit)
