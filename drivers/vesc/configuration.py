"""The motor's values in a VESC's own configuration, as its answer to GET_MCCONF holds them.

What follows the command is a signature of the layout and the values, packed without names. Two layouts are known
(`confgenerator.c` of the firmware with these signatures, 6.05 and 6.06); they differ behind the flux only. Another
firmware's answer is not read.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.vesc.requests import GET_MCCONF
from servo_daemon.errors import WireError

#: Signature: where the number of the motor's poles stands, counted from the signature's first byte.
_POLES_AT: Mapping[int, int] = {1_065_524_471: 450, 2_509_944_602: 448}
#: Ratio of the encoder and the kind of sensor; L, difference of Lq and Ld, R, flux.
_ENCODER_AT, _MOTOR_AT = 145, 158
#: `foc_sensor_mode`: an encoder on the shaft.
_WITH_ENCODER = 1


@dataclass(frozen=True, slots=True)
class MotorConfiguration:
    """As the drive's own measurement, or its owner, has set it.

    Attributes:
        R, L, flux: of a phase, Ω and H; Wb, peak.
        pole_pairs: turns of the electrical angle for one of the shaft: the encoder's ratio where there is one, else
            half of "motor poles" (which the firmware needs for nothing but a display: it may never have been set).
    """

    R: float
    L: float
    flux: float
    pole_pairs: int

    def nominal(self) -> dict[str, float]:
        """R, L, K of the equivalent DC motor with phase values (`servo_daemon.signal_meaning`); only possible ones."""
        values = {"R": self.R, "L": self.L, "K": math.sqrt(1.5) * self.pole_pairs * self.flux}
        return {name: value for name, value in values.items() if math.isfinite(value) and value > 0.0}


def decode_configuration(payload: bytes) -> MotorConfiguration:
    """The answer to GET_MCCONF.

    Raises:
        WireError: another payload, another firmware's, or one that is cut off.
    """
    if payload[:1] != bytes([GET_MCCONF]) or len(payload) < 5:
        raise WireError(f"a payload of {len(payload)} bytes is no motor configuration")
    body = payload[1:]
    (signature,) = struct.unpack_from(">I", body)
    poles_at = _POLES_AT.get(signature)
    if poles_at is None:
        raise WireError(f"a motor configuration with signature {signature} is another firmware's than 6.05 and 6.06")
    if len(body) <= poles_at:
        raise WireError(f"{len(body)} bytes are no whole motor configuration")
    ratio, sensor = struct.unpack_from(">fB", body, _ENCODER_AT)
    L, _, R, flux = struct.unpack_from(">4f", body, _MOTOR_AT)
    by_encoder = sensor == _WITH_ENCODER and math.isfinite(ratio) and 0.5 <= ratio <= 100.0
    return MotorConfiguration(R, L, flux, round(ratio) if by_encoder else body[poles_at] // 2)
