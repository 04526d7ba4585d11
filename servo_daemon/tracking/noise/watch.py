"""What the innovations say: noise of channels, input and unmodelled torque, and whether they are white."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from servo_daemon.kalman.records import ChannelStatistics, NoiseLevels
from servo_daemon.tracking.noise import levels as noise
from servo_daemon.tracking.noise.levels import ChannelNoise, ProcessNoise, Whiteness

#: The correlation of the current's innovations with the motion's a sample later is small: averaged over so long, s, and
#: weighted up (without it `test_follows_linear_ageing_with_honest_intervals` fails); more so where the winding has
#: settled between two samples and nothing else tells the two noises apart (without it
#: `test_the_winding_is_right_where_the_shaft_s_balance_does_not_close` fails). Chosen; free within half and twice.
_CROSS_MEMORY_S, _CROSS_WEIGHT, _CROSS_WEIGHT_SETTLED = 10.0, 4.0, 10.0
#: Of a sensor's noise that is known from elsewhere at least this much stays, however small the innovations are beside
#: what a filter that has just started expects of them (free within a half and twice: tests/recovery/constants.py).
_LEAST_SHARE = 0.5
#: Whiteness, by the correlation of neighbouring innovations: leaves at the second value, returns at the first (see
#: `make calibrate`).
WHITE_IN, WHITE_OUT = 0.15, 0.25
#: White, but only because process noise was raised by this factor: not white. Of the torque; of the held input, whose
#: noise is a drive's own (dead time, ripple) up to 1.4 % of its rms (see `make calibrate`).
_UNEXPLAINED = (10.0, 200.0)
#: A tick is unexplained above so many standard deviations of its mean square, or with so many outliers (see `make
#: calibrate`).
_UNEXPLAINED_NIS = 7.0
_FEWEST_GATED, _GATED_SHARE = 3, 0.03

_NONE = ProcessNoise()


@dataclass(frozen=True, slots=True)
class InnovationTest:
    """Test of a tick's innovations for size and whiteness.

    Attributes:
        nis: largest mean of ν²/s of a channel.
        unexplained: beyond what the noise explains, and not by chance: outliers, or large and one following the other
            (large but white is noise that has grown).
    """

    nis: float
    unexplained: bool


def judged(statistics: Mapping[str, ChannelStatistics]) -> InnovationTest:
    """Test of a tick's innovations for size and whiteness."""
    worst, unexplained = 0.0, False
    for s in statistics.values():
        if s.count < 1:
            unexplained |= s.gated >= _FEWEST_GATED
            continue
        correlation, nis = s.correlation, s.nis
        worst = max(worst, nis)
        spread = math.sqrt(2.0 / s.count)  # of the mean square of as many white innovations
        drifts = nis > 1.0 + _UNEXPLAINED_NIS * spread and correlation > max(0.2, 3.0 / math.sqrt(s.count))
        unexplained |= drifts or s.gated >= max(_FEWEST_GATED, _GATED_SHARE * s.count)
    return InnovationTest(worst, unexplained)


@dataclass(frozen=True, slots=True)
class WatchMark:
    """What a watch had learned at some time; see `InnovationWatch`."""

    channel: Mapping[str, ChannelNoise]
    process: Mapping[str, ProcessNoise]
    pool: Mapping[str, tuple[ChannelStatistics, float]]
    whiteness: Mapping[str, Whiteness]
    updates: Mapping[str, int]
    crossed: float
    too_much: bool
    white: bool


class InnovationWatch:
    """Noise levels and whiteness from the innovations of each tick.

    Args:
        measured: the filter's channels; the last one shows the motion.

    Attributes:
        whiteness: per channel, once it has been seen.
        white: with hysteresis: innovations are uncorrelated, and not only because process noise was raised.
        gated: samples that were weighted down as outliers.
        settled: 0 .. 1: how far the current has settled from one sample to the next.
    """

    def __init__(self, measured: tuple[str, ...]) -> None:
        self._measured = measured
        self._channel: dict[str, ChannelNoise] = {}
        self._first_var: dict[str, float] = {}
        self._process: dict[str, ProcessNoise] = {}
        self._pool: dict[str, tuple[ChannelStatistics, float]] = {}
        self._updates: dict[str, int] = {}
        self._crossed = 0.0
        self._too_much = False
        self.whiteness: dict[str, Whiteness] = {}
        self.white = True
        self.gated = 0
        self.settled = 0.0

    def start(self, channels: Mapping[str, ChannelNoise]) -> None:
        """Begin with these levels; what was found about the model before is forgotten."""
        self._channel = dict(channels)
        self._first_var = {name: c.var for name, c in channels.items()}
        self._process = {}
        self._pool, self._updates, self._crossed = {}, {}, 0.0
        self._too_much = False

    def mark(self) -> WatchMark:
        """What has been learned, for `back_to`."""
        return WatchMark(
            channel=dict(self._channel),
            process=dict(self._process),
            pool=dict(self._pool),
            whiteness=dict(self.whiteness),
            updates=dict(self._updates),
            crossed=self._crossed,
            too_much=self._too_much,
            white=self.white,
        )

    def back_to(self, mark: WatchMark) -> None:
        """Forget what has been learned since."""
        self._channel, self._process = dict(mark.channel), dict(mark.process)
        self._pool, self.whiteness, self._updates = dict(mark.pool), dict(mark.whiteness), dict(mark.updates)
        self._crossed, self._too_much, self.white = mark.crossed, mark.too_much, mark.white

    def learn_anew(self) -> None:
        """The filter's values are others now: of a slow drive, whose first samples say little of its sensors, what the
        innovations say of them counts as in the beginning."""
        if self._pool:
            self._pool, self._updates = {}, {}

    def expect_sensor(self, name: str, var: float) -> None:
        """Of the noise that the channel showed in its first samples its sensor makes at most this, in its unit squared.
        The rest is what it measures."""
        first = self._channel[name]
        if var < first.var:
            floor = max(first.floor, _LEAST_SHARE * var)
            self._channel[name] = ChannelNoise(max(var, floor), floor)
            self._first_var[name] = self._channel[name].var

    @property
    def noise_var(self) -> dict[str, float]:
        """Noise variance of the measured channels, in their units squared."""
        return {name: c.var for name, c in self._channel.items()}

    @property
    def least_noise_var(self) -> dict[str, float]:
        """The same, but no more than what the first samples showed by themselves: a model that lacks something is no
        noise."""
        return {name: min(c.var, self._first_var[name]) for name, c in self._channel.items()}

    def levels(self, input_rms: float, input_lsb: float | None, torque_Nm: float) -> NoiseLevels:
        """Noise levels that the filter is to work with.

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

    def expect_torque(self, psd: float, torque_Nm: float) -> None:
        """The shaft's balance leaves a torque that the model does not explain: it is at least as large.

        Args:
            psd: as a white torque, (N·m)²·s.
            torque_Nm: typical motor torque.
        """
        name = self._measured[-1]
        factor = psd / noise.torque_intensity(torque_Nm)
        if factor > self._of(name).factor and not self._too_much:
            self._process[name] = ProcessNoise(min(factor, noise.FACTOR_MOST))

    def expect_input(self, var: float, input_rms: float, input_lsb: float | None) -> None:
        """Begin with a held input that is known no better than to this variance, in its unit squared.

        Args:
            input_rms, input_lsb: of the held input, in its unit.
        """
        if var / noise.input_variance(input_rms, input_lsb) > self._of("current_A").factor:
            self.put_input(var, input_rms, input_lsb)

    def put_sensor(self, name: str, var: float) -> None:
        """A channel's noise is this, in its unit squared, as far as its resolution allows."""
        floor = self._channel[name].floor
        self._channel[name] = ChannelNoise(max(var, floor), floor)

    def put_input(self, var: float, input_rms: float, input_lsb: float | None) -> None:
        """Set the held input's noise to this, or to the least that it has.

        Args:
            input_rms, input_lsb: as for `expect_input`.
        """
        factor = var / noise.input_variance(input_rms, input_lsb)
        self._process["current_A"] = ProcessNoise(min(max(factor, 1.0), noise.FACTOR_MOST))

    def judge(self, statistics: Mapping[str, ChannelStatistics]) -> InnovationTest:
        """Test the innovations of a tick; nothing is learned yet."""
        self.gated += sum(int(s.gated) for s in statistics.values())
        return judged(statistics)

    def learn(self, statistics: Mapping[str, ChannelStatistics], duration_s: float) -> None:
        """Let a tick's innovations move noise levels and whiteness."""
        for name, tick in statistics.items():
            pooled = self._pool.get(name)
            s, span_s = (tick, duration_s) if pooled is None else (pooled[0].joined(tick), pooled[1] + duration_s)
            if s.count < noise.FEWEST_TO_LEARN:  # a slow drive: a tick is too small a sample
                self._pool[name] = s, span_s
                continue
            self._pool.pop(name, None)
            follow = None
            if name == "current_A":
                # What moves the current really moves the shaft a sample later; where the winding is faster than the
                # sampling this alone tells voltage noise from sensor noise.
                follow = s.correlation + self._cross_weight() * self._crossed
            self._process[name] = self._noise_after(name, s, follow)
            self.whiteness[name] = self.whiteness.get(name, Whiteness()).after(s.correlation, s.nis, span_s)
            if name == self._measured[-1]:
                self._crossed += (1.0 - math.exp(-span_s / _CROSS_MEMORY_S)) * (s.crossed - self._crossed)
            self._updates[name] = self._updates.get(name, 0) + 1
            nis = s.nis if pooled is not None else 1.0
            self._channel[name] = noise.adapted(self._channel[name], s.excess, span_s, self._updates[name], nis)
        self._judge()

    def _cross_weight(self) -> float:
        return _CROSS_WEIGHT + (_CROSS_WEIGHT_SETTLED - _CROSS_WEIGHT) * self.settled**2

    def _noise_after(self, name: str, s: ChannelStatistics, follow: float | None) -> ProcessNoise:
        """A torque moves the current too. Innovations of the current that are too small beside a torque that was
        raised say that the torque is too large, not the input.

        `test_beside_an_effect_of_a_stranger_the_motor_becomes_known` fails without it."""
        motion = self._measured[-1]
        raised = name != motion and self._of(motion).factor > _UNEXPLAINED[False]
        if name == "current_A":
            self._too_much = raised and s.nis < noise.NIS_LOW
            if self._too_much:
                return self._of(name)
        return self._of(name).after(s.correlation, s.nis, follow, too_much=name == motion and self._too_much)

    def _of(self, name: str) -> ProcessNoise:
        return self._process.get(name, _NONE)

    def _judge(self) -> None:
        if not self.whiteness:
            return
        # Innovations that are smaller than they should be are of a channel whose noise is not known yet.
        correlation = max((abs(w.correlation) for w in self.whiteness.values() if w.nis > noise.NIS_LOW), default=0.0)
        unexplained = max((n.factor / _UNEXPLAINED[c == "current_A"] for c, n in self._process.items()), default=0.0)
        out, limit = (WHITE_OUT, 2.0) if self.white else (WHITE_IN, 1.0)
        self.white = bool(correlation < out and unexplained < limit)
