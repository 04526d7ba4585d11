"""`[[drive]]` and its tables, with keys, defaults and checks; `deploy/example.toml` explains each key."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from servo_daemon.config.section import NAME, FiniteFloat, PositiveFloat, Section
from servo_daemon.config_hints import did_you_mean
from servo_daemon.config_texts import is_limit, parse_days, parse_drift
from servo_daemon.errors import BadInputError, ConfigError
from servo_daemon.fleet.prior_file import nominal_of, read_prior
from servo_daemon.plant.effects import check_effects, parameter_table
from servo_daemon.signal_meaning import SignalMeaning

_ALARM = re.compile(r"(?P<parameter>\w+)_(?P<side>max|min)")


class EstimationConfig(Section):
    """The table `[drive.estimation]`."""

    engine: Literal["compiled", "filterpy"] = "compiled"
    skew_s: float = Field(1e-5, ge=0)
    refresh: bool = True  # RF+GRNN beside the filter
    refresh_every_s: float = Field(10.0, ge=2, le=86400)
    refresh_window_s: float = Field(5.0, ge=2, le=10)
    hold_s: float = Field(10.0, ge=0)  # longest that a value is held which the motion shows and nothing confirms
    ring_s: float = Field(60.0, ge=0, le=600)  # 0: no samples are kept, and no diagnosis is possible
    diagnose: Literal["on_mismatch", "on_request", "never"] = "on_mismatch"
    adopt: Literal["ask", "auto", "never"] = "ask"


class LoadConfig(Section):
    """`[drive.load]`: what is known of load and encoder."""

    mass_kg: PositiveFloat | None = None
    arm_length_m: PositiveFloat | None = None
    counts_per_rev: PositiveFloat | None = None


class LimitsConfig(BaseModel):
    """`[drive.limits]`: what the drive may be asked to do, and alarms such as `R_max = "+30 %"` or `R_max = 1.4`."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)

    voltage_V: PositiveFloat | None = None
    current_A: PositiveFloat | None = None
    velocity_rad_s: PositiveFloat | None = None
    travel_rad: PositiveFloat | None = None
    warn_before: str = "180 d"  # an event when the time until a limit may be shorter

    @field_validator("warn_before")
    @classmethod
    def _warn_before_is_readable(cls, text: str) -> str:
        parse_days(text)
        return text

    @property
    def warn_before_d(self) -> float:
        """How long before a limit is reached to warn, days."""
        return parse_days(self.warn_before)

    @model_validator(mode="after")
    def _alarms_are_known(self) -> LimitsConfig:
        for key, value in (self.model_extra or {}).items():
            match = _ALARM.fullmatch(key)
            known = (*parameter_table(), "J_d")
            if match is None or match["parameter"] not in known:
                alarms = (f"{name}_{side}" for name in known for side in ("max", "min"))
                raise ValueError(f"unknown key '{key}'{did_you_mean(key, (*type(self).model_fields, *alarms))}")
            if not is_limit(value):
                raise ValueError(f"'{key}' must be a number or a text such as \"+30 %\", not {value!r}")
        return self

    @property
    def alarms(self) -> Mapping[str, float | str]:
        """Alarm keys and their limits as written."""
        return dict(self.model_extra or {})


class SignalsConfig(Section):
    """`[drive.signals]`: what voltage and current are (`signal_meaning.py`); a key left out is as the driver says."""

    voltage: Literal["held", "instant", "mean"] | None = None
    current: Literal["instant", "mean"] | None = None
    convention: Literal["dc", "dq"] | None = None
    publish: Literal["phase", "line", "kt"] | None = None
    pole_pairs: int | None = Field(None, ge=1)
    gear_ratio: PositiveFloat | None = None
    truncated_A: float | None = Field(None, ge=0)
    truncated_V: float | None = Field(None, ge=0)
    current_late_s: float | None = Field(None, ge=0)
    voltage_scale_std: float | None = Field(None, ge=0)
    control_period_s: float | None = Field(None, ge=0)
    temperature: Literal["winding", "elsewhere"] = "elsewhere"  # what the drive's temperature is of

    def meaning(self, otherwise: SignalMeaning | None = None) -> SignalMeaning:
        """With these keys; the others as the driver says."""
        return (otherwise or SignalMeaning()).with_keys(self.model_dump(exclude_none=True, exclude={"temperature"}))


class ControllerConfig(Section):
    """`[drive.controller]`: the gains now in use (position loop around speed loop, `tuning/laws.py`), the loop's
    timing, when its margins are too small, and what `tune` is to aim at."""

    position_kp_1_s: float | None = Field(None, ge=0)
    position_ki_1_s2: float | None = Field(None, ge=0)
    position_kd: float | None = Field(None, ge=0)
    speed_kp_V_s_rad: float | None = Field(None, ge=0)
    speed_ki_V_rad: float | None = Field(None, ge=0)
    speed_setpoint_weight: float = Field(1.0, ge=0, le=1)
    speed_filter_hz: PositiveFloat | None = None
    rate_hz: float | None = Field(None, gt=0, le=1e6)
    delay_samples: float = Field(1.0, ge=0, le=20)
    bandwidth_hz: PositiveFloat | None = None
    settling_s: PositiveFloat | None = None
    phase_margin_min_deg: float = Field(30.0, gt=0, lt=90)
    gain_margin_min_dB: float = Field(6.0, gt=0, le=40)
    sensitivity_max: float = Field(2.0, gt=1, le=10)

    @model_validator(mode="after")
    def _asks_for_one(self) -> ControllerConfig:
        if self.bandwidth_hz is not None and self.settling_s is not None:
            raise ValueError("bandwidth_hz and settling_s: give one of them")
        return self


class CommissionConfig(Section):
    """`[drive.commission]`: whether `commission` may move the motor, and how far; from where it stands."""

    allow_motion: bool = False
    voltage_V: PositiveFloat | None = None
    current_A: PositiveFloat | None = None
    speed_rad_s: PositiveFloat | None = None
    travel_rad: PositiveFloat | None = None
    temperature_C: PositiveFloat | None = None  # of the drive's own sensor
    seconds: PositiveFloat = 60.0  # of motion

    @model_validator(mode="after")
    def _motion_has_limits(self) -> CommissionConfig:
        names = ("voltage_V", "current_A", "speed_rad_s", "travel_rad")
        if self.allow_motion and (missing := [n for n in names if getattr(self, n) is None]):
            raise ValueError(f"allow_motion = true needs the limits {', '.join(missing)}")
        return self


def _of_fleet(path: Any) -> dict[str, float]:
    """Raises ValueError where it is no file of `servo-daemon fleet`."""
    if path is None:
        return {}
    if not isinstance(path, str):
        raise ValueError("from must be the path of a fleet.parquet")
    try:
        return nominal_of(read_prior(Path(path)))
    except BadInputError as error:
        raise ValueError(f"from: {error}") from None


class DriveConfig(Section):
    """One `[[drive]]`. `options` belongs to the driver, which checks it itself when it is made."""

    name: str = "axis1"
    driver: str = "simulated"
    model: tuple[str, ...] = ()
    nominal: dict[str, FiniteFloat] = {}  # noqa: RUF012 (pydantic copies it)
    estimation: EstimationConfig = EstimationConfig()
    signals: SignalsConfig = SignalsConfig()
    drift: dict[str, str] = {}  # noqa: RUF012
    load: LoadConfig = LoadConfig()
    limits: LimitsConfig = LimitsConfig()
    controller: ControllerConfig = ControllerConfig()
    commission: CommissionConfig = CommissionConfig()
    options: dict[str, Any] = {}  # noqa: RUF012

    @field_validator("name")
    @classmethod
    def _name_fits_an_url(cls, name: str) -> str:
        if not NAME.fullmatch(name):
            raise ValueError("must be letters, digits, '_', '-' or '.', at most 64, starting with a letter or digit")
        return name

    @field_validator("model")
    @classmethod
    def _effects_exist(cls, model: tuple[str, ...]) -> tuple[str, ...]:
        try:
            check_effects(model)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return model

    @field_validator("nominal", mode="before")
    @classmethod
    def _nominal_is_possible(cls, nominal: Any) -> Any:
        """A choice may be given by its name: `channel = "current_A"`. `from` is a fleet's prior; what stands beside it
        goes before its values."""
        if not isinstance(nominal, Mapping):
            return nominal
        table = parameter_table()
        read = _of_fleet(nominal.get("from"))
        nominal = {name: given for name, given in nominal.items() if name != "from"}
        for name, given in nominal.items():
            if name not in table:
                parameters = f"parameters are {', '.join(sorted(table))}"
                raise ValueError(f"unknown key '{name}'{did_you_mean(name, table)}: {parameters}")
            try:
                read[name] = table[name].read(given)
            except ValueError as error:
                raise ValueError(f"{name} = {error}") from None
        if read.get("J_m", 0.0) > read.get("J", math.inf):
            raise ValueError(f"J_m = {read['J_m']:g} kg·m² of the bare motor is more than J = {read['J']:g} with load")
        return read

    @field_validator("drift")
    @classmethod
    def _drift_is_readable(cls, drift: dict[str, str]) -> dict[str, str]:
        for name, text in drift.items():
            if name not in parameter_table():
                raise ValueError(f"unknown key '{name}'{did_you_mean(name, parameter_table())}")
            try:
                parse_drift(text)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return drift

    def drift_per_sqrt_s(self, name: str) -> float | None:
        """Random-walk intensity of log(parameter), 1/√s, as configured; None where it is not."""
        text = self.drift.get(name)
        return None if text is None else parse_drift(text)
