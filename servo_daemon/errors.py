"""The typed errors of the project: one tree, so that a caller can catch as much as it can handle."""

from __future__ import annotations


class ServoDaemonError(Exception):
    """Base of every error this project raises on purpose. Its text is one line a user can act on."""

    exit_code = 1


class BadInputError(ServoDaemonError):
    """Something the user gave is wrong (a file, a flag, a config); the text names the place."""

    exit_code = 2


class ConfigError(BadInputError):
    """A configuration file, an environment override or a flag is wrong."""


class CaptureError(BadInputError):
    """A capture cannot be used; the text names file, line and column."""


class TuningError(BadInputError):
    """Gains cannot be found: something they need is not known, or what was asked for is out of reach."""


class ModelError(BadInputError):
    """A drive cannot have the model that was asked for.

    Attributes:
        where: what is wrong: `effects`, `effects.1`, `parameters.Tc`.
        known: names that would be right, if that is what is wrong.
    """

    def __init__(self, where: str, text: str, known: tuple[str, ...] = ()) -> None:
        super().__init__(text)
        self.where, self.known = where, known


class DiagnosisError(ServoDaemonError):
    """A diagnosis of a running drive came to nothing; the text says why."""


class BusyError(ServoDaemonError):
    """What was asked for cannot be begun now; the text says why, and a later attempt may succeed."""


class RefusedError(ServoDaemonError):
    """What was asked for is switched off by the configuration."""


class DriverError(ServoDaemonError):
    """Base of everything a driver raises."""


class DriverConfigError(DriverError, ConfigError):
    """The driver's options are wrong: no retry can help (a DBC lacks the mapped signal, an unknown option)."""


class DriverUnavailableError(DriverError):
    """The device cannot be opened now (port missing, busy, no permission); a later attempt may succeed."""


class DriverDisconnectedError(DriverError):
    """The device was open and went away (unplugged, bus off); close and open again."""


class EndOfStreamError(DriverError):
    """A finite source (a replayed capture) has delivered its last sample."""


class WireError(DriverError):
    """Bytes that are not a valid frame. Decoders count these; they do not let them escape from `read`."""


class NumericalError(ServoDaemonError):
    """A computation left the range in which its result means anything (a covariance lost definiteness)."""
