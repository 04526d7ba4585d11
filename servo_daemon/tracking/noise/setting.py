"""Tells the filter how large its noise is: the watch's factors, the signals' scales, and what the balances leave."""

from __future__ import annotations

import math

import numpy as np

from servo_daemon.kalman.ekf import Ekf
from servo_daemon.regression.motor_rls import MotorRls
from servo_daemon.regression.sampling import Sampling, coarse
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64
from servo_daemon.tracking.noise.quantised_input import QuantisedInput
from servo_daemon.tracking.noise.watch import InnovationWatch, WatchMark
from servo_daemon.tracking.plan.parameter_masks import ParameterMasks
from servo_daemon.tracking.samples.signal_scales import SignalScales


class NoiseSetting:
    """Sets the noise of one filter. A filter whose noise is set too low learns the wrong thing for certain, and what it
    learned stays: torque and voltage noise begin with what the regressions' balances leave unexplained before it
    starts."""

    def __init__(
        self, masks: ParameterMasks, ekf: Ekf, rls: MotorRls, watch: InnovationWatch, signal_scales: SignalScales
    ) -> None:
        self._masks, self._ekf, self._rls, self._watch, self._signal_scales = masks, ekf, rls, watch, signal_scales
        self._quantised = QuantisedInput()
        self._input_lsb = self._torque_Nm = 0.0
        self._value: dict[str, float] = {}

    def begin(self, input_lsb: float, sampling: Sampling) -> F64:
        """A filter has started. Returns one unit of each coordinate, shape (n,).

        Args:
            input_lsb: step of the held input, in its unit; 0 where there is none.
        """
        self._input_lsb = input_lsb
        self._quantised.lsb_V = input_lsb if self._ekf.plant.drive == "voltage" else 0.0
        scales = self.rescale(sampling)
        found = self._rls.window.current_noise(sampling)
        hidden = self._hidden_in_current(sampling, found)
        if found is not None and "current_A" in sampling.noise_var:
            self._watch.expect_sensor("current_A", found)
            sampling = self.sampling(sampling.period_s)
        var = max(self._rls.window.input_noise(self._value, sampling) or 0.0, hidden)
        self._watch.expect_input(var, self._signal_scales.input_square**0.5, self._input_lsb)
        self.set()
        return scales

    def sampling(self, period_s: float) -> Sampling:
        """Noise as it is known by now, and what else integrals over samples are off by.

        Args:
            period_s: usual distance of two samples.
        """
        signals = self._signal_scales
        return Sampling(self._watch.least_noise_var, signals.current_step_square, period_s, signals.samples_per_count)

    def _hidden_in_current(self, sampling: Sampling, sensor_var: float | None) -> float:
        """Variance of a held voltage that makes the current's noise, as far as that is not its sensor's and the winding
        is faster than the sampling: there the two look alike. Taken for nothing but the sensor's, the current's noise
        would move no shaft.

        Args:
            sensor_var: what the shaft's balance leaves to the sensor, A²; None: not known, and half of it is.
        """
        whole = sampling.noise_var.get("current_A", 0.0)
        flows = max(whole - (whole / 2 if sensor_var is None else sensor_var), 0.0)
        R, slow = self._value.get("R", 0.0), coarse("armature", sampling.period_s)  # there motion passes for noise
        return flows * (R * self._watch.settled) ** 2 * (1.0 - slow)

    def take(self, tick: Stretch, period_s: float) -> None:
        """Take a tick's samples while the filter runs."""
        if tick.voltage is not None and len(tick.voltage) and "L" in self._masks.names:
            self._quantised.take(tick.voltage, period_s, self._value)

    def rescale(self, sampling: Sampling) -> F64:
        """The scales of the signals, and the torque that the shaft's balance leaves, have changed. Returns one unit of
        each coordinate, shape (n,)."""
        self._value = self._masks.values(self._ekf.coordinates)
        self._torque_Nm = self._signal_scales.torque_Nm(self._value)
        if {"R", "L"} <= self._value.keys():
            self._watch.settled = 1.0 - math.exp(-sampling.period_s * self._value["R"] / self._value["L"])
        unexplained = self._rls.window.unexplained_torque(self._value, sampling, self._torque_Nm)
        size = self._value.get("K", 1.0) if self._ekf.plant.drive == "current" else 1.0
        unexplained = max(unexplained, size**2 * self._signal_scales.unseen_square * sampling.period_s)
        self._watch.expect_torque(unexplained, self._torque_Nm)
        return np.array(self._signal_scales.scales(self._value))

    def set(self) -> None:
        """Set the filter's noise as it is known by now."""
        input_rms = self._signal_scales.input_square**0.5
        self._ekf.set_noise(self._watch.levels(input_rms, self._input_lsb, self._torque_Nm))

    @property
    def of_current(self) -> tuple[float, float] | None:
        """Variances of the current's sensor and of the held voltage, A² and V²; None: one of them is not there."""
        if self._ekf.plant.drive != "voltage" or "current_A" not in self._ekf.channels:
            return None
        return self._watch.noise_var["current_A"], self._ekf.noise.input_var

    def put_of_current(self, sensor_A2: float, voltage_V2: float) -> None:
        """Set the variances of `of_current`, no lower than resolutions and the voltage's least noise allow."""
        self._watch.put_sensor("current_A", sensor_A2)
        self._watch.put_input(voltage_V2, self._signal_scales.input_square**0.5, self._input_lsb)
        self.set()

    def mark(self) -> WatchMark:
        """What has been learned, for `watch_back_to`."""
        return self._watch.mark()

    def watch_back_to(self, mark: WatchMark) -> None:
        """What has been learned since is forgotten; the filter is told by the next `set`."""
        self._watch.back_to(mark)

    def inductance_std(self, period_s: float) -> float:
        """1 σ of ln L that the steps of the recorded voltage leave open."""
        return self._quantised.inductance_std(period_s, self._value) if "L" in self._value else 0.0
