"""One drive's estimators together: RLS from the first sample, the EKF once it can start, and the watch over both.

Fed segments of samples (`take`, any size) and ticks (`close_tick`, always the same samples whatever the segments were);
only ticks change anything but the filter's own recursion.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from servo_daemon.estimators import balances, jumps
from servo_daemon.estimators.base import Gaussian, from_coordinate
from servo_daemon.estimators.ekf import Ekf
from servo_daemon.estimators.excitation import Excitation
from servo_daemon.estimators.fusion import QUALIFIED, Qualification, confirms
from servo_daemon.estimators.jumps import JumpWatch, Known
from servo_daemon.estimators.layout import Layout, Stretches, breaks, channel, gaps
from servo_daemon.estimators.levels import Levels
from servo_daemon.estimators.motor_rls import MotorRls
from servo_daemon.estimators.settings import Message, Resolutions, TrackerSettings
from servo_daemon.estimators.signals import EFFECT_OF, SignalPlan, plan_signals
from servo_daemon.estimators.start import well_known
from servo_daemon.estimators.starter import NUISANCE_SHARE, Start, Starter
from servo_daemon.estimators.stretch import Stretch, median
from servo_daemon.estimators.watch import InnovationWatch, TickVerdict
from servo_daemon.plant.build import PlantModel
from servo_daemon.plant.parameters import LINEAR, Parameter
from servo_daemon.samples import F64, SampleBlock

#: A saved state may be of yesterday's temperature and load: added 1 σ.
_SAVED_STD = 0.03
#: An unexcited parameter's covariance grows with its drift up to this 1 σ.
_IDLE_STD = 0.3
#: Diverged: innovations this many times larger than they should be, for as many ticks, while the regression is well.
_DIVERGED_NIS, _DIVERGED_TICKS = 6.0, 20
#: The noise levels need so many ticks before they can tell what is unusual; a Cholesky factor is tried this often.
_TICKS_TO_LEARN_NOISE, _SOUNDNESS_EVERY = 30, 20
#: Nothing qualifies in the first ticks: noise levels are still guesses.
_TICKS_TO_QUALIFY = 8
#: A current that shows one value for so long, s, is told of.
_FROZEN_S = 0.5
#: A filter that started from little has this long to find out for itself, ticks.
_TICKS_TO_BEGIN_BETTER = 50
#: By then the covariance is widened once, 1 σ over the scales.
_SECOND_START_STD = 0.04
#: An offset that the user's model does not hold is told of beyond this share of its scale; hysteresis.
_OFFSET_OUT, _OFFSET_IN = 0.10, 0.07


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
        wanted = {*self.plan.free, *self.plan.held}
        self._prior = prior if prior is not None and set(prior.names) == wanted else None
        self.last_s: float | None = None
        self.first_s: float | None = None
        self.measured_state: dict[str, float | None] = {}
        self.sample_period_s: float | None = None
        self.restarts = 0
        self.watch = InnovationWatch(self.plan.measured)
        self.rls: MotorRls | None = None
        self.ekf: Ekf | None = None
        if self.plan.plant is not None:
            self._prepare(self.plan.plant)

    def _prepare(self, plant: PlantModel) -> None:
        loop = None
        if self.settings.engine == "filterpy":
            from servo_daemon.estimators.filterpy_ekf import FilterpyLoop

            loop = FilterpyLoop(plant, self.plan.measured)
        self._names = names = plant.parameter_names
        self.ekf = Ekf(plant, self.plan.measured, loop)
        self.rls = MotorRls(plant, self.plan.held)
        self.excitation = Excitation(len(names))
        self.qualification = Qualification(len(names))
        self._layout = Layout(plant.drive, self.plan.measured)
        self._stretches = Stretches()
        self._starter = Starter(self.plan, self.nominal, self.rls.names)
        self._levels = Levels(plant)
        self._jumps = JumpWatch()
        self._published = np.array([name in self.plan.free for name in names])
        self._nuisance = np.array([name in self.plan.nuisance for name in names])
        self._covered = np.array([name in self.rls.in_regression for name in names]) & self._free
        self._drift = np.array([self.settings.drift_of(n, offset=n in self.plan.nuisance) for n in names])
        self._logarithmic = np.array([p.transform == "log" for p in plant.parameters])
        self._confirmed = np.ones(len(names), dtype=bool) if self._prior is not None else ~self._covered
        self._mismatch_std = np.zeros(len(names))
        self._outliers: list[NDArray[np.bool_]] = []
        self._said_frozen = False
        self._before: tuple[F64, float] | None = None
        self._tick_end_s: float | None = None
        self._suspicious_ticks = self._ticks = 0
        self._was_white = True

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The parameters that are estimated and published, in the plant's order."""
        if self.plan.plant is None:
            return ()
        return tuple(p for p in self.plan.plant.parameters if p.name in self.plan.free)

    @property
    def _free(self) -> NDArray[np.bool_]:
        """What the filter estimates, the nuisance parameters included."""
        free: NDArray[np.bool_] = self._published | self._nuisance
        return free

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
        if not cuts and not holes:
            self._update(block)
            return
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
                self.ekf.doubt_input(self._levels.input_step_square)
            self._update(part)

    def _update(self, part: SampleBlock) -> None:
        assert self.ekf is not None
        innovations = self.ekf.update(self._layout.rows(part, self._levels.input_square))
        self._outliers.append(np.asarray(np.any(innovations.gated, axis=1)))

    def _first_state(self, block: SampleBlock) -> F64:
        """Plant states at the first sample of a block: what is measured; the last known where that is no measurement
        (looking further would make the result depend on where blocks end); the model's start for the rest."""
        assert self.plan.plant is not None and self.ekf is not None
        x = np.array([s.initial for s in self.plan.plant.states])
        first = block.slice(0, 1)
        for k, state in enumerate(self.plan.plant.states):
            if state.name in self.plan.measured:
                values, valid = channel(first, state.name)
                x[k] = values[0] if valid is None or valid[0] else self.ekf.x[k]
        return x

    # -- ticks -----------------------------------------------------------------------------------------------

    def close_tick(self, tick: SampleBlock) -> list[Message]:
        """Everything slower than a sample, over exactly the samples of this tick."""
        if len(tick) > 1:
            self.sample_period_s = median(tick.time_s[1:] - tick.time_s[:-1])
        if self.plan.plant is None or self.rls is None or self.ekf is None:
            return []
        duration = max((self.sample_period_s or 0.0) * len(tick), 1e-6)
        assert self.first_s is not None
        stretch = self._stretches.of(tick, self.first_s, self._tick_end_s, self.sample_period_s)
        self._levels.take(stretch)
        self._tick_end_s = float(tick.time_s[-1])
        if not self.ekf.started:
            self.rls.update(stretch, self._noise_var())
            return self._try_start(tick)
        return self._watch(stretch, duration)

    def _noise_var(self) -> dict[str, float]:
        """Of the measured channels: as the filter has found it, or what the resolutions alone make of it."""
        if self.ekf is not None and self.ekf.started:
            return self.watch.noise_var
        steps = {name: self.resolutions.of(name) for name in self.plan.measured}
        return {name: step**2 / 12.0 for name, step in steps.items() if step is not None}

    def _try_start(self, tick: SampleBlock) -> list[Message]:
        assert self.first_s is not None and self.rls is not None and self.plan.plant is not None
        elapsed = float(tick.time_s[-1]) - self.first_s
        found = self.rls.estimate()
        scales = dict(zip(self.plan.plant.parameter_names, self._levels.scales(self.nominal), strict=True))
        start = self._starter.take(tick, elapsed, self._prior, found, self.resolutions, scales)
        if start is None:
            return []
        self._begin(start)
        source = "the saved state" if self._prior is not None else "regression and nominal values"
        return [("filter_started", f"filter started from {source}", {})]

    def _begin(self, start: Start) -> None:
        assert self.ekf is not None
        self.watch.start(start.noise)
        self._input_lsb = start.input_lsb
        self._layout.expect_steps(start.position_lsb, start.input_lsb)
        self.ekf.start(start.parameters, held_input=self._layout.last_input)
        self._jumps.reset()
        self._ticks, self._before, self._outliers = 0, None, []
        self._rescale()
        self._set_noise()
        self.ekf.set_active(self._free.astype(np.float64), self._walk(self._free))
        self.ekf.forget_state(self._first_state(start.last))

    def _rescale(self) -> None:
        """The scales follow the levels of the signals."""
        values = self._values()
        self.excitation.scales = np.array(self._levels.scales(values))
        self._torque_Nm = self._levels.torque_Nm(values)

    def _set_noise(self) -> None:
        assert self.ekf is not None
        self.ekf.set_noise(self.watch.levels(self._levels.input_square**0.5, self._input_lsb, self._torque_Nm))

    def _values(self) -> dict[str, float]:
        """All parameters of the plant as the filter has them, natural units."""
        assert self.ekf is not None and self.plan.plant is not None
        coordinates = self.ekf.coordinates
        return {
            p.name: from_coordinate(p, c, 0.0)[0]
            for p, c in zip(self.plan.plant.parameters, coordinates.tolist(), strict=True)
        }

    def _walk(self, walking: NDArray[np.bool_]) -> F64:
        """Process noise per coordinate, 1/s."""
        return np.asarray(np.where(walking, np.square(self._drift * self.excitation.scales), 0.0))

    def _watch(self, stretch: Stretch, duration_s: float) -> list[Message]:
        """Noise, whiteness, jumps, excitation, soundness: after each tick of the running filter."""
        assert self.ekf is not None and self.rls is not None
        self._ticks += 1
        sound = self.ekf.is_sound if self._ticks % _SOUNDNESS_EVERY == 0 else self.ekf.is_plausible
        if not sound():
            return self._restart("its covariance or state is no longer sound")
        statistics = self.ekf.take_statistics()
        verdict = self.watch.judge(statistics)
        action: jumps.Action = "learn"
        if self._ticks > _TICKS_TO_LEARN_NOISE and stretch.complete:
            action = self._jumps.judge(verdict.unexplained, verdict.settled)
        messages = self._act(action)
        # What the filter does not believe, the regressions are not told either.
        believed = stretch.usable & ~np.concatenate(self._outliers) & (action != "undo")
        fresh = self.rls.update(replace(stretch, usable=believed), self._noise_var())
        self._outliers = []
        if action == "learn" and stretch.complete:
            self.watch.learn(statistics, duration_s)
        if fresh:
            self._rescale()
        self._set_noise()
        self._judge_excitation(duration_s, fresh)
        if self._ticks == _TICKS_TO_LEARN_NOISE:
            # What was learned with noise levels that were only guessed, and from a start that was, is taken for less.
            self.ekf.widen_parameters(
                np.where(self._published, np.square(_SECOND_START_STD * self.excitation.scales), 0)
            )
        if self._jumps.quiet:
            self._before = self.ekf.snapshot(), self._tick_end_s or 0.0
        messages += self._say_whether_white() + self._say_whether_frozen(stretch)
        return messages + (self._judge_divergence(verdict) or self._begin_better(fresh))

    def _act(self, action: jumps.Action) -> list[Message]:
        """Do with the last tick what the watch for jumps has decided."""
        assert self.ekf is not None
        if self._before is None or action in ("learn", "settle"):
            return []
        before = self._known_before()
        if action in ("undo", "open", "reject"):
            self.ekf.put_parameters(before.mean, before.covariance)
            self.ekf.forget_motion(self.ekf.x)  # it was led astray as well
        if action == "open":
            self.ekf.widen_parameters(self._opening())
        if action == "accept":
            return self._report_jump(before)
        return []

    def _known_before(self) -> Known:
        """What was known of the parameters before something happened."""
        assert self.ekf is not None and self._before is not None
        state, time_s = self._before
        mean, covariance = self.ekf.parameters_of(state)
        return Known(self._names, mean, covariance, time_s)

    def _opening(self) -> F64:
        """Added to the coordinates' variances while a jump is looked for, shape (n,)."""
        std = np.where(self._logarithmic, jumps.OPEN_STD, jumps.OPEN_SIGNED_STD) * self.excitation.scales
        return np.asarray(np.where(self._free, std**2, 0.0))

    def _report_jump(self, before: Known) -> list[Message]:
        assert self.ekf is not None and self.plan.plant is not None
        candidates = (self._published & self.qualification.qualified & self.excitation.excited) | self._nuisance
        moved = jumps.jumped(before, self.ekf.coordinates, self.ekf.coordinate_std, self.excitation.scales, candidates)
        assert self.rls is not None
        self.rls.begin_window()
        stayed = self._free.copy()
        stayed[moved] = False
        self.ekf.recall(stayed, before.mean, before.covariance)
        after = self.ekf.coordinates
        return [
            jumps.message(self.plan.plant.parameters[k], before, float(after[k]), self._tick_end_s or 0.0)
            for k in moved
            if self._published[k]
        ]

    def _judge_excitation(self, duration_s: float, fresh: bool) -> None:
        assert self.ekf is not None and self.rls is not None and self.plan.plant is not None
        if fresh:
            self.excitation.determine(
                self.rls.determined(self._names, self._values(), self.watch.noise_var), self._covered
            )
        self.excitation.update(self.ekf.take_information(), duration_s)
        excited, std = self.excitation.excited, self.ekf.coordinate_std / self.excitation.scales
        if fresh:
            self._confirmed = self._confirmed_by_regression()
            if self._jumps.quiet:
                self._measure_mismatch()
        settled = self._confirmed & (self._ticks >= _TICKS_TO_QUALIFY or self._prior is not None)
        self.qualification.update(np.hypot(std, self._mismatch_std), excited, settled)
        # What no regression can judge is free until it has been seen once: there is nothing to hold yet.
        known = self.qualification.qualified | self._covered
        held = self.excitation.held(known) & (not self._jumps.is_open)
        idle = np.where(self._nuisance, NUISANCE_SHARE, _IDLE_STD)
        walking = self._free & ((excited & ~self._nuisance) | (std < idle))
        self.ekf.set_active((self._free & ~held).astype(np.float64), self._walk(walking))
        self.ekf.use_instrument(bool((std[self._published & excited] < QUALIFIED).all()))

    def _measure_mismatch(self) -> None:
        """How far the parameters may be off because the balances do not close; kept while a parameter is not
        excited."""
        assert self.rls is not None
        noise = dict(self.watch.noise_var)
        if "current_A" in noise:
            noise["current_A"] += 0.25 * self._levels.current_step_square
        found = self.rls.mismatch(self._values(), noise, self.sample_period_s or 0.0)
        for k, name in enumerate(self._names):
            if self.excitation.excited[k] and self._logarithmic[k]:
                self._mismatch_std[k] = found.get(name, 0.0)

    def _confirmed_by_regression(self) -> NDArray[np.bool_]:
        """Parameters whose value the regression confirms, or cannot judge at all because it is in none."""
        assert self.rls is not None
        if self._prior is not None:
            return np.ones(len(self._names), dtype=bool)  # it was qualified when it was saved
        out = ~self._covered
        found, values = self.rls.estimate(), self._values()
        if found is None:
            return out
        for name, value, std in zip(found.names, found.value.tolist(), found.std.tolist(), strict=True):
            k = self._names.index(name)
            # Between two samples the current has settled: integrals over samples cannot show what it did meanwhile.
            blind = name == "L" and values["L"] < (self.sample_period_s or 0.0) * values["R"]
            if self._logarithmic[k] and not blind:
                out[k] = confirms(value, std * balances.ALIGNED.get(name, 1.0), values[name])
            else:
                out[k] = True
        return out

    def _say_whether_white(self) -> list[Message]:
        if self.explained == self._was_white:
            return []
        self._was_white = self.explained
        if self._was_white:
            return [("model_fits", "innovations are white again: the model explains the data", {})]
        if self.watch.white:
            names = " and ".join(EFFECT_OF[self._names[k]] for k in np.flatnonzero(self._large_offsets()))
            return [("model_mismatch", f"the data hold an offset that the model does not: add {names}", {})]
        return [("model_mismatch", "innovations are not white: the data hold what the model does not", {})]

    def _say_whether_frozen(self, stretch: Stretch) -> list[Message]:
        """A current that no longer flickers while the voltage moves is no measurement; nobody else would notice."""
        moves = stretch.voltage is not None and float(np.ptp(stretch.voltage)) > 0.0
        seconds = self._stretches.alike("current_A") * (self.sample_period_s or 0.0)
        if self._said_frozen and seconds == 0.0:
            self._said_frozen = False
            return [("channel_alive", "current_A moves again", {})]
        if self._said_frozen or seconds < _FROZEN_S or not moves:
            return []
        self._said_frozen = True
        return [("channel_frozen", "current_A shows one value although the voltage moves: it is not believed", {})]

    def _large_offsets(self) -> NDArray[np.bool_]:
        """Nuisance parameters too large to be one."""
        assert self.ekf is not None
        limit = (_OFFSET_OUT if self._was_white else _OFFSET_IN) * self.excitation.scales
        return np.asarray(self._nuisance & (np.abs(self.ekf.coordinates) > limit + 3.0 * self.ekf.coordinate_std))

    @property
    def explained(self) -> bool:
        """Whether the model explains the data: innovations are white, and without an offset that is not in it."""
        if self.ekf is None or not self.ekf.started:
            return True
        return self.watch.white and not bool(self._large_offsets().any())

    def _judge_divergence(self, verdict: TickVerdict) -> list[Message]:
        assert self.ekf is not None and self.rls is not None
        self._suspicious_ticks = self._suspicious_ticks + 1 if verdict.nis > _DIVERGED_NIS else 0
        if self._suspicious_ticks >= _DIVERGED_TICKS and not self._jumps.is_open:
            found = self.rls.estimate()
            if well_known(found, [p.name for p in self.free if p in LINEAR]):
                return self._restart("its innovations do not fit while the regression does")
        return []

    def _begin_better(self, fresh: bool) -> list[Message]:
        """The filter had to start from little and still does not know what the regression knows by now: begin from
        that."""
        assert self.rls is not None and self.ekf is not None
        core = [p for p in self.free if p in LINEAR]
        index = [self._names.index(p.name) for p in core]
        std = self.ekf.coordinate_std[index] / self.excitation.scales[index]
        lost = ~self.qualification.qualified[index] & (std > QUALIFIED)
        if not fresh or not lost.any() or self._ticks < _TICKS_TO_BEGIN_BETTER:
            return []
        if not well_known(self.rls.estimate(), [p.name for p in core]):
            return []
        self._restart("")
        self.restarts -= 1
        return []

    def _restart(self, why: str) -> list[Message]:
        """Back to the start: the next tick begins again from the regression."""
        assert self.ekf is not None
        self.ekf.reset()
        self._starter.reset()
        self._prior = None
        self._suspicious_ticks = 0
        self.qualification.qualified[:] = False
        self.excitation.reset()
        self.restarts += 1
        return [("filter_restarted", f"filter restarted: {why}", {"restarts": self.restarts})]

    def published(self) -> Gaussian | None:
        """What is to be published of all parameters; None before the filter runs. Beside the filter's own spread: what
        the balances leave open. While something unexplained is being looked into it is what was known before, with the
        spread that it has by now."""
        if self.ekf is None or not self.ekf.started:
            return None
        balance = np.diag(np.square(self._mismatch_std))
        if self._before is None or not self._jumps.is_open:
            g = self.ekf.estimate()
            return Gaussian(g.names, g.mean, g.covariance + balance)
        before = self._known_before()
        return Gaussian(before.names, before.mean, before.covariance + np.diag(self._opening()) + balance)

    def worth_keeping(self) -> Gaussian | None:
        """Qualified parameters for a later run, with what may have changed meanwhile; None unless all are well."""
        if self.ekf is None or not self.ekf.started or not self.ekf.is_sound() or self._suspicious_ticks:
            return None
        if not self._jumps.quiet or not self.qualification.qualified[self._published].all():
            return None
        g, kept = self.ekf.estimate(), np.flatnonzero(~self._nuisance)
        covariance = g.covariance + np.diag(np.square(_SAVED_STD * self.excitation.scales))
        return Gaussian(tuple(g.names[k] for k in kept), g.mean[kept], covariance[np.ix_(kept, kept)])
