"""One drive's estimators together: RLS from the first sample, the EKF once it can start, and the watch over both.

Fed segments of samples (`take`, any size) and ticks (`close_tick`, always the same samples whatever the segments were);
only ticks change anything but the filter's own recursion.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import block_diag

from servo_daemon.estimators import noise as noise_levels
from servo_daemon.estimators.base import Gaussian, to_coordinate
from servo_daemon.estimators.ekf import Ekf, Innovations
from servo_daemon.estimators.excitation import Excitation
from servo_daemon.estimators.fusion import Qualification
from servo_daemon.estimators.layout import INPUT, Layout, breaks, channel, gaps, stretch_of
from servo_daemon.estimators.motor_rls import MotorRls
from servo_daemon.estimators.settings import Resolutions, TrackerSettings
from servo_daemon.estimators.signals import SignalPlan, plan_signals
from servo_daemon.estimators.start import starting_point, well_known
from servo_daemon.estimators.watch import InnovationWatch
from servo_daemon.plant.parameters import LINEAR, Parameter
from servo_daemon.samples import F64, SampleBlock, concatenate

Message = tuple[str, str, Mapping[str, float | int | str | None]]

#: Random walk of a parameter's coordinate when the user says nothing, 1 σ after a minute: copper follows the load,
#: magnets and bearings take their time, inertia changes with what is mounted.
_DRIFT_PER_SQRT_MIN = {"R": 0.03, "L": 0.006, "K": 0.01, "J": 0.015, "B": 0.03}
_DRIFT_OTHER_PER_SQRT_MIN = 0.02

#: Measurements of each channel that a start needs: its noise is judged by them.
_FEWEST_TO_START = 50
#: The filter starts no sooner than this after the first sample, s, and waits no longer than that for the regression.
_EARLIEST_S, _LATEST_S = 1.0, 3.0
#: A saved state may be of yesterday's temperature and load: added 1 σ.
_SAVED_STD = 0.03
#: An unexcited parameter's covariance grows with its drift up to this 1 σ.
_IDLE_STD = 0.3
#: Diverged: innovations this many times larger than they should be, for as many ticks, while the regression is well.
_DIVERGED_NIS, _DIVERGED_TICKS = 6.0, 20


class Tracker:
    """See the module. `plan` says what these channels determine."""

    def __init__(
        self,
        channels: tuple[str, ...],
        settings: TrackerSettings,
        resolutions: Resolutions,
        prior: Gaussian | None = None,
    ) -> None:
        self.settings, self.resolutions = settings, resolutions
        self.nominal = dict(settings.nominal or {})
        self.plan: SignalPlan = plan_signals(channels, settings.effects, self.nominal)
        names = () if self.plan.plant is None else self.plan.plant.parameter_names
        self._prior = prior if prior is not None and set(prior.names) == set(names) else None
        self.last_s: float | None = None
        self.first_s: float | None = None
        self.measured_state: dict[str, float | None] = {}
        self.sample_period_s: float | None = None
        self.restarts = 0
        self.watch = InnovationWatch(self.plan.measured)
        self.rls: MotorRls | None = None
        self.ekf: Ekf | None = None
        if self.plan.plant is not None:
            self._prepare()

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The parameters that are estimated, in the plant's order."""
        if self.plan.plant is None:
            return ()
        return tuple(p for p in self.plan.plant.parameters if p.name in self.plan.free)

    def _prepare(self) -> None:
        plant = self.plan.plant
        assert plant is not None
        given = self.settings.drift_per_sqrt_s or {}
        default = {
            p.name: _DRIFT_PER_SQRT_MIN.get(p.name, _DRIFT_OTHER_PER_SQRT_MIN) / 60**0.5 for p in plant.parameters
        }
        self._drift = np.array([given.get(p.name, default[p.name]) ** 2 for p in plant.parameters])
        self._free_index = np.array([k for k, p in enumerate(plant.parameters) if p.name in self.plan.free], dtype=int)
        loop = None
        if self.settings.engine == "filterpy":
            from servo_daemon.estimators.filterpy_ekf import FilterpyLoop

            loop = FilterpyLoop(plant, self.plan.measured)
        self.ekf = Ekf(plant, self.plan.measured, self._drift, loop)
        self.rls = MotorRls(plant, self.plan.held)
        self._layout = Layout(plant.drive, self.plan.measured)
        self.excitation = Excitation(np.ones(len(plant.parameters)))
        self.qualification = Qualification(len(plant.parameters))
        self._input_square = 0.0
        self._early: list[SampleBlock] = []
        self._tick_end_s: float | None = None
        self._suspicious_ticks = 0
        self._innovations: list[Innovations] = []
        self._rows: list[F64] = []

    # -- samples ---------------------------------------------------------------------------------------------

    def take(self, block: SampleBlock) -> None:
        """Samples of one tick or a part of it, in order."""
        if self.first_s is None:
            self.first_s = float(block.time_s[0])
            if self.plan.plant is not None:
                self._layout.origin_s = self.first_s
        if self.plan.plant is not None:
            self._filter(block)
        self.last_s = float(block.time_s[-1])
        for name in ("current_A", "velocity_rad_s", "position_rad"):
            values = getattr(block, name)
            self.measured_state[name] = None if values is None else float(values[-1])

    def _filter(self, block: SampleBlock) -> None:
        assert self.ekf is not None
        if not self.ekf.started:
            self._layout.rows(block, 0.0)
            return
        cuts = breaks(block, self.last_s)
        holes = gaps(block, self.last_s, self.sample_period_s)
        edges = sorted({*cuts, *holes})
        for a, b in zip([0, *edges], [*edges, len(block)], strict=True):
            if b <= a:
                continue
            part = block.slice(a, b)
            if a in cuts or not holes.get(a, True):
                self._layout.last_s = float(part.time_s[0])  # begins at this sample: no prediction up to it
                forget = self.ekf.forget_state if a in cuts else self.ekf.forget_motion
                forget(self._first_state(part))
            elif a in holes:
                self.ekf.doubt_input(self._input_square)
            rows = self._layout.rows(part, self._input_square)
            self._innovations.append(self.ekf.update(rows))
            self._rows.append(rows)

    def _first_state(self, block: SampleBlock) -> F64:
        """Plant states at the first sample of a block: what is measured; the last known where that is no measurement
        (looking further would make the result depend on where blocks end); the model's start for the rest."""
        assert self.plan.plant is not None and self.ekf is not None
        x = np.array([s.initial for s in self.plan.plant.states])
        first = block.slice(0, 1)
        for k, state in enumerate(self.plan.plant.states):
            if state.name in self.plan.measured:
                values, valid = channel(first, state.name)
                x[k] = values[0] if valid[0] else self.ekf.x[k]
        return x

    # -- ticks -----------------------------------------------------------------------------------------------

    def close_tick(self, tick: SampleBlock) -> list[Message]:
        """Everything slower than a sample, over exactly the samples of this tick."""
        if len(tick) > 1:
            self.sample_period_s = float(np.median(np.diff(tick.time_s)))
        if self.plan.plant is None or self.rls is None or self.ekf is None:
            return []
        duration = max((self.sample_period_s or 0.0) * len(tick), 1e-6)
        self._measure_levels(tick)
        assert self.first_s is not None
        self.rls.update(stretch_of(tick, self.first_s, self._tick_end_s, self.sample_period_s))
        self._tick_end_s = float(tick.time_s[-1])
        if not self.ekf.started:
            return self._try_start(tick)
        return self._watch(duration)

    def _measure_levels(self, tick: SampleBlock) -> None:
        """Mean squares of input and motor torque, for noise that is a share of them."""
        assert self.plan.plant is not None
        u, valid = channel(tick, INPUT[self.plan.plant.drive])
        if valid.any():
            square = float(np.sum(u * u) / valid.sum())
            self._input_square = max(square, 0.99 * self._input_square)

    def _try_start(self, tick: SampleBlock) -> list[Message]:
        assert self.ekf is not None and self.rls is not None and self.first_s is not None
        self._early.append(tick)
        elapsed = float(tick.time_s[-1]) - self.first_s
        enough = sum(len(b) for b in self._early) >= _FEWEST_TO_START
        if not enough or elapsed < (0.2 if self._prior is not None else _EARLIEST_S):
            return []
        recording = concatenate(self._early)
        measured = {name: channel(recording, name) for name in self.plan.measured}
        start = self._prior if self._prior is not None else self._best_start(elapsed)
        if start is None or any(valid.sum() < _FEWEST_TO_START for _, valid in measured.values()):
            while len(self._early) > 20 and len(recording) > 8 * _FEWEST_TO_START:
                recording = recording.slice(len(self._early.pop(0)), len(recording))
            return []
        self.watch.start(
            {
                name: noise_levels.initial_noise(values[valid > 0], self.resolutions.of(name))
                for name, (values, valid) in measured.items()
            }
        )
        self._layout.position_lsb = self._encoder_step(measured)
        self.ekf.start(start, held_input=self._layout.last_input, held_var=0.0)
        self._set_noise()
        free = self._free_mask()
        self.ekf.set_active(free, free)
        self.ekf.forget_state(self._first_state(recording.slice(len(recording) - 1, len(recording))))
        self._early = []
        source = "the saved state" if self._prior is not None else "regression and nominal values"
        return [("filter_started", f"filter started from {source}", {})]

    def _encoder_step(self, measured: Mapping[str, tuple[F64, F64]]) -> float:
        """Least significant bit of the position, rad; 0 where it is not quantised."""
        if self.resolutions.position_rad is not None:
            return self.resolutions.position_rad
        if "position_rad" not in measured:
            return 0.0
        values, valid = measured["position_rad"]
        return noise_levels.smallest_step(values[valid > 0])

    def _best_start(self, elapsed_s: float) -> Gaussian | None:
        """None while there is still something to wait for."""
        assert self.rls is not None and self.plan.plant is not None
        found = self.rls.estimate()
        core = [p.name for p in self.free if p.transform == "log" and p.name in self.rls.names]
        if elapsed_s < _LATEST_S and not well_known(found, core):
            return None
        start = starting_point(self.free, found, self.nominal)
        if start is None:
            return None
        held = [p for p in self.plan.plant.parameters if p.name in self.plan.held]
        names = (*start.names, *(p.name for p in held))
        mean = np.concatenate([start.mean, [to_coordinate(p, self.plan.held[p.name]) for p in held]])
        return Gaussian(names, mean, block_diag(start.covariance, np.zeros((len(held), len(held)))))

    def _free_mask(self) -> F64:
        assert self.plan.plant is not None
        mask = np.zeros(len(self.plan.plant.parameters))
        mask[self._free_index] = 1.0
        return mask

    def _set_noise(self) -> None:
        assert self.ekf is not None and self.plan.plant is not None
        rms = self._input_square**0.5
        lsb = self.resolutions.voltage_V if self.plan.plant.drive == "voltage" else None
        torque = self._torque_scale()
        self.ekf.set_noise(self.watch.levels(rms, lsb, torque))

    def _torque_scale(self) -> float:
        """Typical motor torque, N·m: K V/R at the rms voltage is the most there can be at standstill."""
        assert self.ekf is not None and self.plan.plant is not None
        names = self.plan.plant.parameter_names
        q = self.ekf.estimate().mean
        rms = self._input_square**0.5
        if self.plan.plant.drive == "voltage":
            return float(np.exp(q[names.index("K")] - q[names.index("R")]) * rms)
        return float(np.exp(q[names.index("K")]) * rms) if self.plan.plant.drive == "current" else rms

    def _watch(self, duration_s: float) -> list[Message]:
        """Noise, whiteness, excitation, soundness: after each tick of the running filter."""
        assert self.ekf is not None
        if not self._innovations:
            return []
        rows = np.concatenate(self._rows)
        innovations = Innovations(
            *(
                np.concatenate([getattr(i, name) for i in self._innovations])
                for name in ("innovation", "variance", "gated")
            )
        )
        self._rows, self._innovations = [], []
        if not (self.ekf.is_sound() and innovations.are_sound()):
            return self._restart("its covariance or state is no longer sound")
        worst = self.watch.after(rows, innovations, duration_s)
        self._set_noise()
        self._judge_excitation(duration_s)
        return self._judge_divergence(worst)

    def _judge_excitation(self, duration_s: float) -> None:
        assert self.ekf is not None and self.plan.plant is not None
        self.excitation.update(self.ekf.take_information(), duration_s)
        std = self.ekf.estimate().std
        self.qualification.update(std, self.excitation.excited)
        free = self._free_mask()
        active = free * self.excitation.excited
        # Until it has been seen once a parameter is always free: it is held only once there is something to hold.
        active = np.where(self.qualification.qualified, active, free)
        walking = free * np.where(self.excitation.excited | (std < _IDLE_STD), 1.0, 0.0)
        self.ekf.set_active(active, walking)

    def _judge_divergence(self, nis: float) -> list[Message]:
        assert self.ekf is not None and self.rls is not None
        self._suspicious_ticks = self._suspicious_ticks + 1 if nis > _DIVERGED_NIS else 0
        if self._suspicious_ticks >= _DIVERGED_TICKS:
            found = self.rls.estimate()
            if well_known(found, [p.name for p in self.free if p in LINEAR]):
                return self._restart("its innovations do not fit while the regression does")
        return []

    def _restart(self, why: str) -> list[Message]:
        """Back to the start: the next tick begins again from the regression."""
        assert self.ekf is not None
        self.ekf.reset()
        self._prior = None
        self._suspicious_ticks = 0
        self._early, self._rows, self._innovations = [], [], []
        self.qualification.qualified[:] = False
        self.excitation.reset()
        self.restarts += 1
        return [("filter_restarted", f"filter restarted: {why}", {"restarts": self.restarts})]

    def worth_keeping(self) -> Gaussian | None:
        """Qualified parameters for a later run, with what may have changed meanwhile; None unless all are well."""
        if self.ekf is None or not self.ekf.started or not self.ekf.is_sound() or self._suspicious_ticks:
            return None
        if not self.qualification.qualified[self._free_index].all():
            return None
        g = self.ekf.estimate()
        return Gaussian(g.names, g.mean, g.covariance + np.eye(len(g.mean)) * _SAVED_STD**2)
