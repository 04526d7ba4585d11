"""Configuration: TOML, checked completely before anything starts; unknown keys are refused by name.

Precedence: command-line flags, then environment (`SERVO_DAEMON_API_HOST`, `SERVO_DAEMON_API_PORT`,
`SERVO_DAEMON_STATE_DIR`), then `conf.d/*.toml` beside the file, then the file, then the defaults of
`sections.py` and `drive_section.py`.
"""

from servo_daemon.config.drive_section import (
    ControllerConfig,
    DriveConfig,
    EstimationConfig,
    LimitsConfig,
    LoadConfig,
    SignalsConfig,
)
from servo_daemon.config.load import load_config, parse_config
from servo_daemon.config.sections import (
    ApiConfig,
    Config,
    DiagnosisConfig,
    HistoryConfig,
    LearningConfig,
    LogConfig,
    StorageConfig,
)
from servo_daemon.config.sinks import MqttConfig, WebhookConfig

__all__ = [
    "ApiConfig",
    "Config",
    "ControllerConfig",
    "DiagnosisConfig",
    "DriveConfig",
    "EstimationConfig",
    "HistoryConfig",
    "LearningConfig",
    "LimitsConfig",
    "LoadConfig",
    "LogConfig",
    "MqttConfig",
    "SignalsConfig",
    "StorageConfig",
    "WebhookConfig",
    "load_config",
    "parse_config",
]
