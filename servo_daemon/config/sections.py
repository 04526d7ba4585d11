"""Every section of the configuration with its keys, defaults and checks; `deploy/example.toml` explains each key."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from servo_daemon.config.sinks import MqttConfig, WebhookConfig
from servo_daemon.config_hints import did_you_mean
from servo_daemon.config_texts import is_limit, parse_days, parse_drift
from servo_daemon.errors import BadInputError, ConfigError
from servo_daemon.fleet.prior_file import nominal_of, read_prior
from servo_daemon.plant.effects import check_effects, parameter_table
from servo_daemon.signal_meaning import SignalMeaning

PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
FiniteFloat = Annotated[float, Field(allow_inf_nan=False)]

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_ALARM = re.compile(r"(?P<parameter>\w+)_(?P<side>max|min)")


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ApiConfig(_Section):
    """`[api]`: where the REST API and the dashboard listen."""

    host: str = "127.0.0.1"
    port: int = Field(8077, ge=0, le=65535)  # 0: any free port, logged at start
    allowed_hosts: tuple[str, ...] = ()  # names under which it may be asked for, beside addresses and local names
    tokens_file: str | None = None  # of `servo-daemon token new`, or credential:NAME; who has none may ask for nothing
    metrics: Literal["token", "open"] = "token"  # whether /metrics needs one, too
    behind_proxy: bool = False  # a proxy in front asks who it is: then other addresses need no tokens
    certificate: str | None = None  # PEM files for TLS, or credential:NAME
    private_key: str | None = None

    @model_validator(mode="after")
    def _certificate_has_its_key(self) -> ApiConfig:
        if (self.certificate is None) != (self.private_key is None):
            raise ValueError("'certificate' and 'private_key' belong together")
        return self


class LogConfig(_Section):
    """`[log]`: what goes to stderr, where neither `--log-level` nor SERVO_DAEMON_LOG_LEVEL says it."""

    level: Literal["debug", "info", "warning", "error"] = "info"


class StorageConfig(_Section):
    """`[storage]`: where state is kept over a restart. None: $STATE_DIRECTORY (systemd), else not at all unless
    the daemon runs with a config file, which then uses the user's state directory."""

    state_dir: str | None = None
    save_interval_s: PositiveFloat = 5.0


class DiagnosisConfig(_Section):
    """`[diagnosis]`: the program that looks for what a drive's model lacks, in a process of its own, one at a time."""

    command: tuple[Annotated[str, Field(min_length=1)], ...] = ()  # empty: this program's own `diagnose`
    budget_s: float = Field(900.0, gt=0, le=86400)
    time_limit_s: float = Field(7200.0, gt=0, le=86400)
    nice: int = Field(15, ge=0, le=19)


class LearningConfig(_Section):
    """`[learning]`: the models of `refresh`. A drive that has none gets one trained in a process of its own."""

    train: bool = True  # false: only models that `servo-daemon train` has made
    motors: int = Field(5000, ge=1)  # simulated, as `servo-daemon train` does
    learner: Literal["grnn", "boosting", "forest", "ridge", "neighbours"] = "grnn"
    nice: int = Field(15, ge=0, le=19)


class HistoryConfig(_Section):
    """`[history]`: what was published, kept for years. Without `url` a SQLite file, `path` or `history.sqlite` in the
    state directory; without one of these in memory only."""

    enabled: bool = True
    path: str | None = None
    url: str | None = None  # postgresql://user@host/database
    rows_hours: float = Field(1.0, ge=0.1, le=1e4)  # single rows, ten a second
    seconds_days: float = Field(1.0, ge=0.1, le=1e4)
    minutes_days: float = Field(90.0, ge=1, le=1e5)
    hours_years: float = Field(20.0, ge=0.1, le=1000)
    quota_MB: float = Field(2000.0, ge=10, allow_inf_nan=False)  # beyond it the oldest of the finer levels go
    captures_quota_MB: float = Field(500.0, ge=0, allow_inf_nan=False)  # of samples around events; 0: none are kept

    @model_validator(mode="after")
    def _one_place(self) -> HistoryConfig:
        if self.path is not None and self.url is not None:
            raise ValueError("path and url: give one of them")
        return self


class EstimationConfig(_Section):
    """`[drive.estimation]`."""

    engine: Literal["compiled", "filterpy"] = "compiled"
    skew_s: float = Field(1e-5, ge=0)
    refresh: bool = True  # RF+GRNN beside the filter
    refresh_every_s: float = Field(10.0, ge=2, le=86400)
    refresh_window_s: float = Field(5.0, ge=2, le=10)
    hold_s: float = Field(10.0, ge=0)  # longest that a value is held which the motion shows and nothing confirms
    ring_s: float = Field(60.0, ge=0, le=600)  # 0: no samples are kept, and no diagnosis is possible
    diagnose: Literal["on_mismatch", "on_request", "never"] = "on_mismatch"
    adopt: Literal["ask", "auto", "never"] = "ask"


class LoadConfig(_Section):
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
        """In days."""
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


class SignalsConfig(_Section):
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
    temperature: Literal["winding", "elsewhere"] = "elsewhere"  # what the drive's temperature is of

    def meaning(self, otherwise: SignalMeaning | None = None) -> SignalMeaning:
        """With these keys; the others as the driver says."""
        return (otherwise or SignalMeaning()).with_keys(self.model_dump(exclude_none=True, exclude={"temperature"}))


class ControllerConfig(_Section):
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


class CommissionConfig(_Section):
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


class DriveConfig(_Section):
    """One `[[drive]]`. `options` belongs to the driver, which checks it itself when it is made."""

    name: str = "axis1"
    driver: str = "simulated"
    model: tuple[str, ...] = ()
    nominal: dict[str, FiniteFloat] = {}
    estimation: EstimationConfig = EstimationConfig()
    signals: SignalsConfig = SignalsConfig()
    drift: dict[str, str] = {}
    load: LoadConfig = LoadConfig()
    limits: LimitsConfig = LimitsConfig()
    controller: ControllerConfig = ControllerConfig()
    commission: CommissionConfig = CommissionConfig()
    options: dict[str, Any] = {}

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


class Config(_Section):
    """The whole configuration."""

    api: ApiConfig = ApiConfig()
    log: LogConfig = LogConfig()
    storage: StorageConfig = StorageConfig()
    diagnosis: DiagnosisConfig = DiagnosisConfig()
    learning: LearningConfig = LearningConfig()
    history: HistoryConfig = HistoryConfig()
    mqtt: MqttConfig | None = None
    webhook: tuple[WebhookConfig, ...] = ()
    drive: tuple[DriveConfig, ...] = (DriveConfig(),)

    @field_validator("drive")
    @classmethod
    def _names_differ(cls, drives: tuple[DriveConfig, ...]) -> tuple[DriveConfig, ...]:
        if not drives:
            raise ValueError("at least one [[drive]] is needed")
        names = [d.name for d in drives]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two drives are named '{name}'")
        return drives

    @model_validator(mode="after")
    def _webhooks_name_drives(self) -> Config:
        names = [d.name for d in self.drive]
        for name in (n for hook in self.webhook for n in hook.drives if n not in names):
            raise ValueError(f"a webhook is for the drive '{name}'{did_you_mean(name, names)}, which is not configured")
        return self

    def drive_named(self, name: str | None) -> DriveConfig:
        """The drive of that name, or the first.

        Raises:
            ConfigError: no such drive.
        """
        if name is None:
            return self.drive[0]
        for drive in self.drive:
            if drive.name == name:
                return drive
        raise ConfigError(f"no drive named {name!r}: the config has {', '.join(d.name for d in self.drive)}")
