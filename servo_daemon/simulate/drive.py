"""The simulated drive: plant, servo, sensors and ageing, delivered as sample blocks.

The samples do not depend on how they are asked for: everything is computed in chunks of one fixed size, each random
channel from a stream of its own, and blocks are cut out of these chunks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.base import DriveInfo
from servo_daemon.plant.compiled import SampleLoop
from servo_daemon.plant.servo_loop import N_OUT, N_ROW, OUT, ROW, ServoGains, servo_constants, servo_step
from servo_daemon.samples import CHANNELS, F64, I64, Quality, SampleBlock, concatenate, make_block
from servo_daemon.simulate.settings import Settings

#: Samples computed at once. Small against memory, large against the 0.1 ms that NumPy costs for each chunk.
CHUNK = 1024

#: Commands go to the motor as they are.
_OPEN_LOOP = ServoGains(k_op=0.0)
_STREAMS = ("jitter", "current", "voltage", "hidden", "position", "velocity")


@dataclass(frozen=True)
class _Chunk:
    """n samples as recorded, and what was true while they were."""

    block: SampleBlock
    parameters: F64  # (n, np)
    states: F64  # (n, states)


class SimulatedDrive:
    """An endless source of samples of a simulated motor.

    Args:
        settings: see `make_settings`.
        compiled: False forces CasADi's virtual machine (the samples are the same).
        loop: over `servo_step` of the same model, where many motors share one; None: the drive makes its own.
    """

    def __init__(self, settings: Settings, *, compiled: bool = True, loop: SampleLoop | None = None) -> None:
        self.settings = settings
        self._loop = SampleLoop(servo_step(settings.model), compiled=compiled) if loop is None else loop
        self._constants = servo_constants(settings.gains, settings.supply_V, settings.sensors.voltage_lsb_V)
        self._state = np.array([s.initial for s in settings.model.states])
        children = np.random.SeedSequence(settings.seed).spawn(len(_STREAMS))
        self._random = {
            name: np.random.Generator(np.random.PCG64(child)) for name, child in zip(_STREAMS, children, strict=True)
        }
        self._computed = 0  # samples computed so far
        self._last_jitter_s = 0.0
        self._chunk: _Chunk | None = None
        self._taken = 0  # samples of the chunk already delivered
        self._last: tuple[F64, F64] | None = None  # parameters and state at the last delivered sample

    @property
    def info(self) -> DriveInfo:
        """What a drive says of itself."""
        return drive_info(self.settings)

    @property
    def most_V(self) -> float:
        """Largest voltage of its supply, V."""
        return self.settings.supply_V

    def next_block(self, n: int) -> SampleBlock:
        """The next n ≥ 1 samples.

        Raises:
            ValueError: n < 1.
        """
        if n < 1:
            raise ValueError(f"a block has at least one sample, not {n}")
        parts: list[SampleBlock] = []
        missing = n
        while missing:
            if self._chunk is None or self._taken == CHUNK:
                self._chunk, self._taken = self._compute(), 0
            count = min(missing, CHUNK - self._taken)
            parts.append(self._chunk.block.slice(self._taken, self._taken + count))
            self._taken += count
            missing -= count
        assert self._chunk is not None
        self._last = self._chunk.parameters[self._taken - 1], self._chunk.states[self._taken - 1]
        return concatenate(parts)

    def commanded_block(self, voltage_V: F64) -> SampleBlock:
        """The next samples with these voltages, shape (n,), V, in place of its own servo's; what its servo had computed
        and nobody has taken is gone."""
        self._chunk, self._taken = None, 0
        constants = servo_constants(_OPEN_LOOP, self.settings.supply_V, self.settings.sensors.voltage_lsb_V)
        chunk = self._compute(len(voltage_V), voltage_V, constants)
        self._last = chunk.parameters[-1], chunk.states[-1]
        return chunk.block

    def truth(self) -> dict[str, float]:
        """True parameters at the last delivered sample (before the first: at the start); J_d too where J_m is given.

        For display and for judging estimators, never for them. Safe from any thread.
        """
        last, ageing = self._last, self.settings.ageing
        values = ageing.values(np.zeros(1))[0] if last is None else last[0]
        truth = {name: float(value) for name, value in zip(self.settings.model.parameter_names, values, strict=True)}
        if ageing.motor_inertia is not None:
            truth["J_d"] = truth["J"] - ageing.motor_inertia
        return truth

    def true_state(self) -> dict[str, float]:
        """The plant's states at the last delivered sample. Safe from any thread."""
        last = self._last
        state = np.array([s.initial for s in self.settings.model.states]) if last is None else last[1]
        return {name: float(value) for name, value in zip(self.settings.model.state_names, state, strict=True)}

    def _compute(self, n: int = CHUNK, voltage_V: F64 | None = None, constants: F64 | None = None) -> _Chunk:
        s, settings = self.settings.sensors, self.settings
        ticks = np.arange(self._computed, self._computed + n + 1, dtype=np.int64)
        even = ticks / settings.rate_hz
        jitter = np.concatenate(([self._last_jitter_s], self._uniform("jitter", s.jitter_s, n)))
        time = even + jitter
        parameters = settings.ageing.values(time[:-1])
        rows = np.empty((n, N_ROW + parameters.shape[1]))
        rows[:, ROW.time_s] = time[:-1]
        rows[:, ROW.step_s] = np.diff(time)
        # The controller's clock ticks evenly; only the sampling jitters.
        commanded = voltage_V is not None
        rows[:, ROW.reference_rad] = 0.0 if commanded else settings.motion.reference(even[:-1])
        rows[:, ROW.dither_V] = voltage_V if commanded else settings.motion.dither(even[:-1])
        rows[:, ROW.hidden_V] = self._noise("hidden", s.hidden_voltage_V, n)
        rows[:, N_ROW:] = parameters
        outputs = self._loop.run(self._state, self._constants if constants is None else constants, rows)
        self._computed += n
        self._last_jitter_s = float(jitter[-1])
        return _Chunk(self._record(time[:-1], ticks[:-1], outputs), parameters, outputs[:, N_OUT:])

    def _record(self, time: F64, ticks: I64, outputs: F64) -> SampleBlock:
        """What the sensors make of the truth."""
        s, n = self.settings.sensors, len(ticks)
        voltage = outputs[:, OUT.voltage_V]
        current = outputs[:, OUT.current_A] + self._noise("current", s.current_noise_A, n)
        saturated = np.abs(voltage) >= self.settings.supply_V
        if s.current_range_A:
            saturated |= np.abs(current) >= s.current_range_A
            current = np.clip(current, -s.current_range_A, s.current_range_A)
        position = outputs[:, OUT.position_rad] + self._noise("position", s.position_noise_rad, n)
        count_rad = 2 * np.pi / s.counts_per_rev if s.counts_per_rev else 0.0
        shown = {
            "voltage_V": voltage + self._noise("voltage", s.voltage_noise_V, n),
            "current_A": _quantised(current, s.current_lsb_A),
            "position_rad": _quantised(position, count_rad),
            "velocity_rad_s": outputs[:, OUT.velocity_rad_s] + self._noise("velocity", s.velocity_noise_rad_s, n),
        }
        channels: dict[str, Any] = {name: np.ascontiguousarray(shown[name]) for name in s.channels}
        return make_block(
            _quantised(time, s.time_lsb_s),
            sequence=ticks,
            quality=np.where(saturated, Quality.SATURATED, Quality.GOOD).astype(np.uint8),
            **channels,
        )

    def _noise(self, stream: str, std: float, n: int) -> F64 | float:
        """n values of noise; each stream is its own, so that switching one off leaves the others as they were."""
        return std * self._random[stream].standard_normal(n) if std else 0.0

    def _uniform(self, stream: str, half_width: float, n: int) -> F64:
        return self._random[stream].uniform(-half_width, half_width, n) if half_width else np.zeros(n)


def drive_info(settings: Settings) -> DriveInfo:
    """What a drive with these settings says of itself; its identity is the same for the same settings."""
    s = settings.sensors
    return DriveInfo(
        identity=f"simulated-{settings.fingerprint}",
        sample_period_s=1.0 / settings.rate_hz,
        counts_per_rev=s.counts_per_rev or None,
        current_lsb_A=s.current_lsb_A or None,
        voltage_lsb_V=s.voltage_lsb_V or None,
        channels=tuple(c for c in CHANNELS if c in s.channels),
    )


def _quantised(values: F64, step: float) -> F64:
    """Rounded to multiples of `step`; as it is for 0."""
    return np.rint(values / step) * step if step else values
