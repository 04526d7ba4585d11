"""How large the drive's signals are: the units in which noise, offsets and small torques are measured."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np

from servo_daemon.numerics import MEDIAN_TO_STD, median
from servo_daemon.plant.build import PlantModel
from servo_daemon.regression.sampling import WINDOW_S, is_slow
from servo_daemon.regression.stretch import Stretch
from servo_daemon.samples import F64
from servo_daemon.tracking.samples.spikes import without_spikes

#: A level falls by this factor a tick when the signal does, but not at rest: that is no smaller motor (half within 7 s;
#: chosen; free: half within 3.5 to 14 s).
_FALL = 0.99
#: A current whose variance within a tick is no larger than so many times its sensor's shows nothing but that; without a
#: current, a voltage that moves by no more than this share of what is usual (decision 17).
_REST_VARIANCES, _REST_SHARE = 4.0, 1e-2
#: An encoder at rest flickers between two counts; one that creeps shows a new one in every so many samples at most, and
#: its steps are no white noise (chosen; half and twice move no tracking figure).
_REST_COUNTS, _CREEP_SAMPLES = 1.5, 20.0
#: Fewer of a tick's changes of the input are wrong ones (two for a sample); a spike is so many times the largest of the
#: others (decision 11).
_WRONG_STEPS, _SPIKE = 5, 4.0
#: Used where neither data nor nominal values say anything yet (half and twice them are free).
_R, _K = 1.0, 0.1


class Recent:
    """A sum over the samples of the last `WINDOW_S`.

    Attributes:
        number: of samples.
        total: the sum.
    """

    def __init__(self) -> None:
        self._ends_s: deque[float] = deque()  # three of plain numbers: to sum these costs next to nothing
        self._numbers: deque[int] = deque()
        self._totals: deque[float] = deque()
        self.number, self.total = 0, 0.0

    def add(self, end_s: float, number: int, total: float) -> None:
        """Take a tick's sum, and when it ended."""
        self._ends_s.append(end_s)
        self._numbers.append(number)
        self._totals.append(total)
        while end_s - self._ends_s[0] > WINDOW_S:
            self._ends_s.popleft()
            self._numbers.popleft()
            self._totals.popleft()
        self.number, self.total = sum(self._numbers), sum(self._totals)


class SignalScales:
    """Mean squares of input and current over the last ticks, the larger ones remembered.

    Args:
        plant: whose input it is.

    Attributes:
        rests: the last tick showed a drive at rest.
    """

    def __init__(self, plant: PlantModel) -> None:
        self._plant, self.rests = plant, False
        self.input_square = 0.0  # V², A² or (N·m)²
        self.input_step_square = 0.0  # of the change from one sample to the next
        # The largest change but for such as a few wrong samples make:
        self._usual_step: float | None = None
        self._usual_current_step: float | None = None
        # Over the seconds that the balances are summed over:
        self.current_step_square = 0.0  # the same of the current
        self.samples_per_count = 1.0  # for how long the angle has shown one value, on average
        self._current_steps, self._counts = Recent(), Recent()
        self._bends: deque[tuple[float, F64]] = deque()  # when the tick ended; off the cubic through the neighbours
        self._current_square: float | None = None

    def take(self, tick: Stretch, period_s: float, position_lsb: float, noise_var: Mapping[str, float]) -> None:
        """Take the samples of a tick, or of several that are judged together.

        Args:
            period_s: usual distance of two samples.
            position_lsb: the encoder's step; 0: none, or not known yet.
            noise_var: of the measured channels.
        """
        self.rests = self._at_rest(tick, position_lsb, noise_var)
        fall = 1.0 if self.rests else _FALL
        held = self._held(tick)
        if held is not None and len(held):
            self.input_square = max(float(held @ held) / len(held), fall * self.input_square)
            steps = held[1:] - held[:-1]
            square = float(steps @ steps) / max(len(steps), 1)
            self.input_step_square = max(square, fall * self.input_step_square)
            self._usual_step = _usual(steps, self._usual_step, fall)
            if self._plant.drive != "voltage" and is_slow(period_s) and len(held) > 4:
                end_s = float(tick.time_s[-1])
                self._bends.append((end_s, np.diff(held, 4) / 6.0))
                while end_s - self._bends[0][0] > WINDOW_S:
                    self._bends.popleft()
        if tick.current is not None and len(tick.current):
            steps = tick.current[1:] - tick.current[:-1]
            # A tick alone may happen to be a quiet one, or the first of a rest after a window of motion.
            self._current_steps.add(float(tick.time_s[-1]), len(steps), float(steps @ steps))
            self.current_step_square = self._current_steps.total / max(self._current_steps.number, 1)
            self._usual_current_step = _usual(steps, self._usual_current_step, fall)
            square = float(tick.current @ tick.current) / len(tick.current)
            self._current_square = max(square, fall * (self._current_square or 0.0))
        if tick.position is not None and len(tick.position):
            moved = float(np.count_nonzero(tick.position[1:] != tick.position[:-1]))
            self._counts.add(float(tick.time_s[-1]), len(tick.position), moved)
            self.samples_per_count = self._counts.number / max(self._counts.total, 1.0)

    @property
    def unseen_square(self) -> float:
        """Of a slow input that is not held: mean square of what its mean from one sample to the next has that no sample
        shows; 0 where samples are frequent enough (`is_slow`). A sample is off the cubic through the two before and the
        two after it by twice that and more, where the input bends or jumps between them. What all of them are off by is
        noise, which the input's own holds."""
        if not self._bends:
            return 0.0
        off = np.concatenate([bends for _, bends in self._bends])
        usual = (median(np.abs(off)) / MEDIAN_TO_STD) ** 2
        return 0.25 * max(float(off @ off) / len(off) - usual, 0.0)

    @property
    def spike_limit(self) -> float:
        """The largest change of the input that is no spike; infinite where that is not known."""
        return math.inf if self._usual_step is None else _SPIKE * self._usual_step

    @property
    def current_spike_limit(self) -> float:
        """The largest change of a measured current that is no spike; infinite where that is not known."""
        return math.inf if self._usual_current_step is None else _SPIKE * self._usual_current_step

    def without_spikes(self, tick: Stretch) -> Stretch:
        """The tick without what was rather misread than measured; see `spikes`."""
        return without_spikes(tick, self._held(tick), self.spike_limit, self.current_spike_limit)

    def _held(self, tick: Stretch) -> F64 | None:
        """The samples of the held input."""
        if self._plant.drive == "voltage":
            return tick.voltage
        return tick.current if self._plant.drive == "current" else tick.torque

    def _at_rest(self, tick: Stretch, position_lsb: float, noise_var: Mapping[str, float]) -> bool:
        """Whether the tick shows an encoder that stands and a winding that nothing happens in: whatever is missing from
        the model, it is not to be seen there, and the noise of the drive is all that is."""
        if tick.position is None or position_lsb == 0.0 or len(tick.position) == 0:
            return False
        most = max(_REST_COUNTS, len(tick.position) / _CREEP_SAMPLES)
        if abs(float(tick.position[-1] - tick.position[0])) / position_lsb > most:
            return False  # the usual case, without looking at all of them
        if float(np.ptp(tick.position)) / position_lsb > most:
            return False
        if tick.current is not None and "current_A" in noise_var:
            return float(np.var(tick.current)) < _REST_VARIANCES * noise_var["current_A"]
        held = self._held(tick)
        return held is None or float(np.var(held)) < _REST_SHARE**2 * self.input_square

    def current_A(self, values: Mapping[str, float]) -> float:
        """Typical current: as measured, or what the rms voltage drives through the winding."""
        if self._current_square is not None:
            return math.sqrt(self._current_square)
        return math.sqrt(self.input_square) / values.get("R", _R)

    def torque_Nm(self, values: Mapping[str, float]) -> float:
        """Typical torque of the motor, N·m."""
        if self._plant.drive == "torque":
            return math.sqrt(self.input_square)
        return values.get("K", _K) * self.current_A(values)

    def scales(self, values: Mapping[str, float]) -> list[float]:
        """One unit of each parameter's coordinate, in the plant's order: 1 for logarithms and angles, else what is
        typical of its unit; never zero."""
        typical = {
            "N·m": self.torque_Nm(values),
            "A": self.current_A(values),
            "V": math.sqrt(self.input_square),
        }
        return [1.0 if p.transform == "log" else max(typical.get(p.unit, 1.0), 1e-12) for p in self._plant.parameters]


def _usual(steps: F64, before: float | None, fall: float) -> float | None:
    """The largest change but for such as a few wrong samples make, of a tick or of those before it."""
    if len(steps) < 2 * _WRONG_STEPS:
        return before
    size, falls_to = np.abs(steps), fall * (before or 0.0)
    if float(np.maximum.reduce(size)) <= falls_to:  # no need to sort them
        return falls_to
    return max(float(np.partition(size, -_WRONG_STEPS)[-_WRONG_STEPS]), falls_to)
