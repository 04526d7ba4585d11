"""Notifications to the user: each once when its cause begins and once when it ends."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64
from servo_daemon.tracking.noise.watch import InnovationWatch
from servo_daemon.tracking.plan.parameter_masks import ParameterMasks
from servo_daemon.tracking.plan.settings import Message
from servo_daemon.tracking.plan.signals import EFFECT_OF

#: A current that shows one value for so long, s, is told of (five ticks; chosen; half and twice move no tracking
#: figure).
_FROZEN_S = 0.5
#: An offset that the user's model does not hold is told of beyond this share of its scale; hysteresis (see `make
#: calibrate`).
_OFFSET_OUT, _OFFSET_IN = 0.10, 0.07


class Notifications:
    """Makes each notification once, and remembers which have been made.

    Args:
        scales: one unit of each coordinate, as it is now.

    Attributes:
        explained: the model explains the data: innovations are white, and without an offset that is not in it.
    """

    def __init__(self, masks: ParameterMasks, ekf: Ekf, watch: InnovationWatch, scales: Callable[[], F64]) -> None:
        self._masks, self._ekf, self._watch, self._scales = masks, ekf, watch, scales
        self.explained, self._said_frozen = True, False

    def whether_white(self, *, seen: bool) -> list[Message]:
        """After each tick. Says it once when the model no longer explains the data, and once when it does again.

        Args:
            seen: some parameter is excited, or has been known. Before that there is no model to be refuted.
        """
        if not seen:
            return []
        explained = self._watch.white and not self._large_offsets()
        if explained == self.explained:
            return []
        self.explained = explained
        if explained:
            return [("model_fits", "innovations are white again: the model explains the data", {})]
        if self._watch.white:
            names = " and ".join(EFFECT_OF[self._masks.names[k]] for k in self._large_offsets())
            return [("model_mismatch", f"the data hold an offset that the model does not: add {names} to `model`", {})]
        text = "innovations are not white: the data hold what the model does not; a diagnosis looks for it"
        return [("model_mismatch", text, {})]

    def whether_frozen(self, stretch: Stretch, alike_s: float) -> list[Message]:
        """A current that no longer flickers while the voltage moves is no measurement; nobody else would notice.

        Args:
            alike_s: for how long it has shown one value; 0 while it flickers.
        """
        if self._said_frozen and alike_s == 0.0:
            self._said_frozen = False
            return [("channel_alive", "current_A moves again", {})]
        if self._said_frozen or alike_s < _FROZEN_S or stretch.voltage is None or float(np.ptp(stretch.voltage)) == 0.0:
            return []
        self._said_frozen = True
        return [("channel_frozen", "current_A shows one value although the voltage moves: it is not believed", {})]

    def _large_offsets(self) -> list[int]:
        """Indices of the bias states too large to be one."""
        if not self._masks.offsets:
            return []
        value, std = self._ekf.coordinates.tolist(), self._ekf.coordinate_std.tolist()
        scales = self._scales().tolist()
        share = _OFFSET_OUT if self.explained else _OFFSET_IN
        return [k for k in self._masks.offsets if abs(value[k]) > share * scales[k] + 3.0 * std[k]]
