"""How far parameters may be off because the balances do not close, or differ from what the balances say."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.parameters import WINDING_NAMES, Parameter
from servo_daemon.regression import residual_analysis
from servo_daemon.regression.estimate import KNOWS
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.sampling import blind_std
from servo_daemon.samples import F64
from servo_daemon.tracking.noise import quantised_input
from servo_daemon.tracking.plan.parameter_masks import ParameterMasks
from servo_daemon.tracking.start.starting_point import USABLE_STD
from servo_daemon.tracking.validity.excitation import Excitation
from servo_daemon.tracking.validity.gates import LOST
from servo_daemon.tracking.validity.last_known import LastKnown
from servo_daemon.tracking.validity.tick import Tick

#: Of a motor whose model lacks something nothing is known better, 1 σ of a logarithm: no balance over samples that
#: could contradict the filter is more exact (chosen; half and twice move no tracking figure).
_DISCREPANCY_STD = 0.01
#: What no balance over samples sees (a spring, a delay) is known no better than this, 1 σ of a logarithm: the filter
#: alone takes what its model is off by for information (chosen; half and twice move no tracking figure).
_ALONE_STD = 0.01
#: Parameters that the balances judge by name (`BalanceWindow.mean_errors`).
_JUDGED = (*WINDING_NAMES, "J", "B", "Tc")


class Mismatch:
    """The systematic uncertainty of one filter's values.

    Attributes:
        std: 1 σ of the coordinates, shape (n,); kept while a parameter is not excited.
    """

    def __init__(
        self, masks: ParameterMasks, ekf: Ekf, rls: MotorRls, excitation: Excitation, last_known: LastKnown
    ) -> None:
        self._masks, self._ekf, self._rls = masks, ekf, rls
        self._excitation, self._last_known = excitation, last_known
        self.std: F64 = np.zeros(len(masks.parameters))
        self._dry: dict[str, float] = {}
        self._doubted: dict[str, float] = {}

    def measure(self, values: Mapping[str, float], tick: Tick) -> None:
        """How far the parameters may be off because the balances do not close, or by the balances' word; kept while a
        parameter is not excited. L of a model that lacks something is known no better than its balance shows it."""
        window, own_std = self._rls.window, self._ekf.coordinate_std
        window.take_residuals(values, tick.sampling.noise_var)
        found, said = window.mismatch(values, tick.sampling), window.mean_errors(values, tick.sampling.period_s)
        dry = window.hidden_friction.moves(tick.end_s, tick.sampling.noise_var) if window.judges_mismatch else None
        self._dry = self._dry if dry is None else dry
        quantised, armature = self._left_by_steps(tick), self._by_armature(values, tick)
        for k, name in enumerate(self._masks.names):
            if not self._excitation.excited[k] or not self._masks.logarithmic[k]:
                continue
            error, var = said.get(name, (0.0, 0.0))
            if tick.is_blind(name, values):
                error = 0.0
            doubt = residual_analysis.unexplained_var(error, var + float(own_std[k]) ** 2) + armature.get(name, 0.0)
            discrepancy = 0.0 if tick.white else _DISCREPANCY_STD
            if name == "L" and not tick.white:  # the least part of its balance: what the model lacks takes its place
                discrepancy = max(discrepancy, math.sqrt(var))
            known = (found.get(name, 0.0), self._dry.get(name, 0.0), float(quantised[k]), discrepancy)
            self.std[k] = math.hypot(*known, math.sqrt(doubt))
        self._doubt_effects()
        self._carry_over_torque()

    def _doubt_effects(self) -> None:
        """An effect's parameters have no balance's word against them: they are as uncertain as a balance that is only
        nearly right leaves them."""
        masks, systematic = self._masks, self._excitation.systematic_std
        for k, p in enumerate(masks.parameters):
            judged = p.name in _JUDGED and masks.covered[k]
            if judged or not self._excitation.excited[k] or not (masks.published[k] and _is_relative(p)):
                continue
            own = float(self.std[k]) if masks.logarithmic[k] else 0.0
            self.std[k] = math.hypot(own, float(systematic[k]) if masks.covered[k] else _ALONE_STD)

    def _by_armature(self, values: Mapping[str, float], tick: Tick) -> dict[str, float]:
        """Variance of the logarithms that the armature's regression leaves where the filter alone is not believed;
        where it is, the regression, which remembers for longer, may be behind a motor that ages.

        - The innovations say that the model lacks something: a torque that is in no model biases the filter, and not
          that balance. By how much they differ, and no better than the regression knows; while it knows nothing, as
          at one speed, by how much it last was.
        - L was never known: the filter holds it at a value that biases R, the regression has one of its own. (Less so
          where the current has settled by the next sample.)
        """
        L_unknown = "L" in values and self._is_unknown("L", USABLE_STD if tick.is_blind("L", values) else LOST)
        found = None if tick.white and not L_unknown else self._rls.estimate()
        if found is None:
            self._doubted = {}
            return {}
        out = {} if tick.white else dict(self._doubted)
        for name in ("R", "K"):
            if name not in found.names or name not in values:
                continue
            at, k = found.names.index(name), self._masks.names.index(name)
            value, spread = float(found.value[at]), float(found.std[at])
            if value > 0.0 and spread < KNOWS * value:
                error, own_var = math.log(values[name] / value), (spread / value) ** 2
                blind = blind_std(name, values, tick.sampling.period_s)
                var = own_var + blind**2 + float(self._ekf.coordinate_std[k]) ** 2
                out[name] = own_var + (error**2 if L_unknown else residual_analysis.unexplained_var(error, var))
        self._doubted = out
        return out

    def _is_unknown(self, name: str, std: float) -> bool:
        """Whether a parameter never qualified, and the filter knows it no better than to this 1 σ of its logarithm."""
        if name not in self._masks.names:
            return False
        k = self._masks.names.index(name)
        return self._last_known.was_never(k) and float(self._ekf.coordinate_std[k]) > std

    def _carry_over_torque(self) -> None:
        """The shaft's balance sees J, B and friction only beside K i: what the armature's leaves open of K, it leaves
        open of them."""
        names = self._masks.names
        if "K" not in names or self.std[names.index("K")] == 0.0:
            return
        at = names.index("K")
        carried = quantised_input.along(self._ekf.estimate().covariance, at, float(self.std[at]))
        for k, name in enumerate(names):
            if name not in WINDING_NAMES and self._excitation.excited[k] and self._masks.logarithmic[k]:
                self.std[k] = math.hypot(float(self.std[k]), float(carried[k]))

    def _left_by_steps(self, tick: Tick) -> F64:
        """What the voltage's steps leave open of each coordinate, 1 σ, shape (n,)."""
        if tick.inductance_std == 0.0 or "L" not in self._masks.names:
            return np.zeros(len(self._masks.parameters))
        covariance = self._ekf.estimate().covariance
        return quantised_input.along(covariance, self._masks.names.index("L"), tick.inductance_std)


def _is_relative(p: Parameter) -> bool:
    """Whether one unit of the coordinate is one whatever the motor: a logarithm, an angle."""
    return p.transform == "log" or p.unit == "rad"
