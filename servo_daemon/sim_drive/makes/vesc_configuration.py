"""A VESC's motor configuration as its firmware packs it: one value after the other, big-endian.

The order and widths are those of `confgenerator_serialize_mcconf` of firmware 6.05 and 6.06. Only what drivers read has
a name; the rest is 0.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

#: B one byte, h two, f four bytes; a name stands for the next value.
_TO_SENSOR = "4B 4f 2h 3f h 2f 6h 5B 3h 2f 3h B 3f 2h 2f 8B 5f B f ratio:f sensor_mode:B 2f L:f f R:f flux:f"
_BEHIND_FLUX = {
    1_065_524_471: "2f h 2f h 2f 3h",
    2_509_944_602: "2f h 2f h 2f h",
}
_TO_SPEED_SOURCE = "6h 8B 3f 3B h B 2h 3B h B 6h 2f h f 2B 3f 6h 2B f B f 3h 2B"
_OVERMODULATION = {1_065_524_471: "", 2_509_944_602: "h"}
_TO_POLES = "B 3f h f B f B 4f h f h f h 2f h f h 2f 6h 4B 4f 2B f 2h 2B poles:B"


def packed(signature: int, values: Mapping[str, float]) -> bytes:
    """Signature and values.

    Args:
        signature: of one of the two firmwares.
        values: `ratio`, `sensor_mode`, `L`, `R`, `flux`, `poles`.
    """
    parts = (_TO_SENSOR, _BEHIND_FLUX[signature], _TO_SPEED_SOURCE, _OVERMODULATION[signature], _TO_POLES, "8f")
    body = struct.pack(">I", signature)
    for word in " ".join(parts).split():
        name, _, kind = word.rpartition(":")
        if name:
            value = values[name]
            body += struct.pack(">" + kind, value if kind == "f" else int(value))
        else:
            body += bytes(struct.calcsize(">" + kind))
    return body
