"""The drive that a plan is made for: from a reference to the voltage that acts, and what the motor then does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servo_daemon.experiment.limits import Limits, Peaks
from servo_daemon.experiment.loop import Reference, ServoGains, servo_voltage
from servo_daemon.experiment.models import Model
from servo_daemon.experiment.statistics import path, rows_of, start_state
from servo_daemon.samples import F64


@dataclass(frozen=True)
class Rig:
    """Motor, limits and sampling.

    Attributes:
        model: the motor with all its effects.
        linear: the same without, of as many draws: shapes are scaled by it.
        limits: of the drive.
        rate_hz: samples a second.
        kind: what a reference is.
        gains: of the servo that follows it; nothing to a voltage.
    """

    model: Model
    linear: Model
    limits: Limits
    rate_hz: float
    kind: Reference
    gains: ServoGains

    def voltage(self, reference: F64, model: Model, draw: int) -> F64:
        """What acts if this draw is true, shape (n,)."""
        if self.kind == "voltage":
            return reference
        values = np.array([model.draws[draw][name] for name in model.plant.parameter_names])
        x0 = start_state(model)
        return servo_voltage(model.plant, values, x0, self.gains, self.kind, reference, self.rate_hz)

    def peaks(self, reference: F64, draw: int = 0) -> Peaks:
        """What the motor with all its effects reaches."""
        return _peaks(*self._run(self.model, reference, draw))

    def linear_share(self, reference: F64) -> float:
        """Of the nearest limit that the linear motor reaches, at most over the draws."""
        draws = range(len(self.linear.draws))
        return max(_peaks(*self._run(self.linear, reference, d)).share(self.limits) for d in draws)

    def displacement(self, reference: F64) -> float:
        """Where the nominal linear motor ends, rad."""
        return float(self._run(self.linear, reference, 0)[1][-1, 2])

    def share_over_time(self, reference: F64) -> F64:
        """At every sample the share of the nearest limit, at most over the draws, shape (n,)."""
        lim = self.limits
        out = np.zeros(len(reference))
        for d in range(len(self.model.draws)):
            v, x = self._run(self.model, reference, d)
            bounds = (lim.current_A, lim.velocity_rad_s, lim.travel_rad)
            shares = [np.abs(v) / lim.voltage_V, *(np.abs(x[:, k]) / b for k, b in enumerate(bounds))]
            out = np.maximum(out, np.max(shares, axis=0))
        return out

    def _run(self, model: Model, reference: F64, draw: int) -> tuple[F64, F64]:
        """Voltage (n,) and states (n, nx)."""
        v = self.voltage(reference, model, draw)
        q = model.coordinates(model.draws[draw])
        return v, path(model, q, start_state(model), rows_of(v, self.rate_hz))


def _peaks(v: F64, states: F64) -> Peaks:
    i, w, theta = (np.abs(states[:, k]) for k in range(3))
    return Peaks(
        float(np.abs(v).max()), float(i.max()), float(w.max()), float(theta.max()), float(np.sqrt(np.mean(i * i)))
    )
