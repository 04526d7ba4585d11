"""The configuration and the daemon's own sections, with keys, defaults and checks; `deploy/example.toml` explains each
key."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from servo_daemon.config.drive_section import DriveConfig
from servo_daemon.config.section import PositiveFloat, Section
from servo_daemon.config.sinks import MqttConfig, WebhookConfig
from servo_daemon.config_hints import did_you_mean
from servo_daemon.errors import ConfigError


class ApiConfig(Section):
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


class LogConfig(Section):
    """`[log]`: what goes to stderr, where neither `--log-level` nor SERVO_DAEMON_LOG_LEVEL says it."""

    level: Literal["debug", "info", "warning", "error"] = "info"


class StorageConfig(Section):
    """`[storage]`: where state is kept over a restart. None: $STATE_DIRECTORY (systemd), else not at all unless
    the daemon runs with a config file, which then uses the user's state directory."""

    state_dir: str | None = None
    save_interval_s: PositiveFloat = 5.0


class DiagnosisConfig(Section):
    """`[diagnosis]`: the program that looks for what a drive's model lacks, in a process of its own, one at a time."""

    command: tuple[Annotated[str, Field(min_length=1)], ...] = ()  # empty: this program's own `diagnose`
    budget_s: float = Field(900.0, gt=0, le=86400)
    time_limit_s: float = Field(7200.0, gt=0, le=86400)
    nice: int = Field(15, ge=0, le=19)


class LearningConfig(Section):
    """`[learning]`: the models of `refresh`. A drive that has none gets one trained in a process of its own."""

    train: bool = True  # false: only models that `servo-daemon train` has made
    motors: int = Field(5000, ge=1)  # simulated, as `servo-daemon train` does
    learner: Literal["grnn", "boosting", "forest", "ridge", "neighbours"] = "grnn"
    nice: int = Field(15, ge=0, le=19)


class HistoryConfig(Section):
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


class Config(Section):
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
