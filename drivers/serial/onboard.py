"""Estimates that the drive itself makes: frame type 3 of the binary wire (docs/protocol.md)."""

from __future__ import annotations

import math
import struct

from drivers.base import OnboardEstimates
from servo_daemon.errors import WireError

#: type, drive id, session, number of parameters, device time in µs, status.
HEADER = struct.Struct("<BBBBIB")
#: Name in ASCII padded with zeros, value, 1 σ (not a number: not known).
ENTRY = struct.Struct("<8sff")
#: As `servo_status` of the exported estimator counts them.
STATUSES = ("starting", "estimating", "tracking", "doubtful", "invalid")


def decode_onboard(payload: bytes, heard_s: float) -> OnboardEstimates:
    """A payload without its CRC.

    Args:
        heard_s: when it arrived, on the host's monotonic clock.

    Raises:
        WireError: it is no such payload.
    """
    if len(payload) < HEADER.size:
        raise WireError(f"estimates of {len(payload)} bytes")
    _, _, _, n, _, status = HEADER.unpack_from(payload)
    if len(payload) != HEADER.size + n * ENTRY.size or status >= len(STATUSES):
        raise WireError(f"estimates of {n} parameters in {len(payload)} bytes with status {status}")
    values = {}
    for name, value, std in ENTRY.iter_unpack(payload[HEADER.size :]):
        try:
            text = name.rstrip(b"\0").decode("ascii")
        except UnicodeDecodeError:
            raise WireError(f"estimates of {name!r}") from None
        values[text] = (value, std if math.isfinite(std) and std >= 0.0 else None)
    return OnboardEstimates(STATUSES[status], {k: v for k, v in values.items() if math.isfinite(v[0])}, heard_s)
