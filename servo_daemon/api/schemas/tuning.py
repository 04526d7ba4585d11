"""What `GET /drives/{d}/tuning` answers with: for OpenAPI, and for the test that holds `tuning/document.py` to it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from servo_daemon.tuning.knowledge import Source


class _Document(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class AskDocument(_Document):
    """What was asked for; neither: half of the bandwidth that each loop can reach."""

    bandwidth_hz: float | None
    settling_s: float | None


class UsedParameterDocument(_Document):
    """One parameter as the gains are computed with."""

    value: float = Field(description="In `unit`.")
    std: float | None = Field(description="1 σ; null where nothing is claimed (a nominal value).")
    unit: str
    source: Source = Field(description="`estimate`: of the running drive. `nominal`: it is not estimated now.")
    reason: str | None = Field(description="In words, why it is not the estimate, or what was done to it.")


class LimitsDocument(_Document):
    """Below these the margins of the gains in use are called weak."""

    phase_margin_deg: float
    gain_margin_dB: float
    sensitivity_peak: float


class WorstMarginsDocument(_Document):
    """Margins of the loop cut at the voltage. Null: no limit in that direction, or the loop is unstable."""

    stable: bool
    gain_margin_dB: float | None = Field(description="By so much the loop's gain may rise.")
    gain_reduction_margin_dB: float | None = Field(description="By so much it may fall.")
    smaller_gain_margin_dB: float | None = Field(description="The nearer of the two.")
    phase_margin_deg: float | None
    delay_margin_s: float | None = Field(description="So much more delay is allowed.")
    sensitivity_peak: float | None = Field(description="M_s, the largest |1/(1+L)|.")


class MarginsDocument(WorstMarginsDocument):
    """At one set of parameters."""

    crossover_hz: float | None = Field(description="Where |L| = 1.")


class WorstDocument(WorstMarginsDocument):
    """The worst of each over `region`, each by itself."""

    at: dict[str, dict[str, float]] = Field(description="Measure -> the parameters (SI units) where it is the worst.")


class ResponseDocument(_Document):
    """To a small step of the reference. Null: not within the time looked at."""

    of: Literal["position_rad", "velocity_rad_s"]
    bandwidth_hz: float | None = Field(description="−3 dB.")
    settling_s: float | None = Field(description="Until it stays within 2 %.")
    rise_s: float | None = Field(description="10 to 90 %.")
    overshoot_percent: float | None
    peak_V_per_unit: float = Field(description="Largest voltage per rad or rad/s of the step.")


class ParallelPidDocument(_Document):
    """The position loop as v = P_on_setpoint θ* − P θ + I ∫(θ* − θ) dt − D ω̂."""

    P_V_rad: float
    I_V_rad_s: float
    D_V_s_rad: float
    P_on_setpoint_V_rad: float


class _LoopDocument(_Document):
    title: str
    law: str = Field(description="The control law, LaTeX.")
    gains: dict[str, float | list[float]] = Field(
        description="Units in their names; those of the PI and PID are the keys of `[drive.controller]`."
    )
    parallel_pid: ParallelPidDocument | None = Field(description="Only of P around PI.")
    margins: MarginsDocument
    worst: WorstDocument | None = Field(description="Null where `region` is.")
    largest_linear_step: float | None = Field(description="Of the reference, until the voltage's limit is met.")
    voltage_per_count_V: float | None = Field(description="Jump of the voltage with one encoder count.")
    breakaway_V: float | None = Field(description="Voltage that dry friction takes before the shaft moves.")
    notes: list[str]


class DesignDocument(_LoopDocument):
    """Gains of one kind of controller."""

    capped: bool = Field(description="What was asked for is out of reach; these are the fastest acceptable gains.")
    reason: str | None
    response: ResponseDocument


class InUseDocument(_LoopDocument):
    """The gains that the drive has now."""

    nominal: MarginsDocument | None = Field(description="With the nominal values.")
    response: ResponseDocument | None = Field(description="Null where the loop is unstable.")
    weak: bool
    warnings: list[str]


class TuningDocument(_Document):
    """Controller gains for the motor as it is."""

    drive: str
    time: str | None = Field(description="Of the estimate that was used: arrival of its last sample, UTC.")
    samples: int
    margin_low: bool | None = Field(
        description="The daemon's standing warning (with hysteresis, looked at every 5 s); null: no gains in use, or "
        "not judged yet."
    )
    rate_hz: float = Field(description="Samples a second of the loop.")
    rate_source: str = Field(description="`configured`, or `measured`: the rate of the samples.")
    delay_samples: float
    voltage_V: float | None
    model: list[str]
    asked: AskDocument
    parameters: dict[str, UsedParameterDocument]
    region: str | None = Field(description="Over which `worst` is the worst; null: nothing is claimed.")
    not_in_region: list[str] = Field(description="Parameters that were held at their value there.")
    limits: LimitsDocument
    speed_filter: str = Field(description="How the speed comes from the encoder, LaTeX.")
    anti_windup: str
    designs: dict[Literal["speed_pi", "position_pid", "lqr"], DesignDocument]
    in_use: InUseDocument | None
