"""Offline identification: captures in, fitted and validated models out. What `fit`, `compare` and `diagnose` share."""

from servo_daemon.identification.procedure.identify import Identification, IdentifyOptions, identify
from servo_daemon.identification.procedure.validate import Validation, adapted_share

__all__ = ["Identification", "IdentifyOptions", "Validation", "adapted_share", "identify"]
