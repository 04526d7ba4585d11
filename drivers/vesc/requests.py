"""All that is ever sent to a VESC: reads. `MAY_SEND` is the whole list, and a test holds the port to it."""

from __future__ import annotations

from drivers.vesc.packets import encode_packet

#: Command numbers of the firmware's datatypes.h, as in tests/drivers/golden/vesc.json.
FW_VERSION, GET_VALUES, GET_VALUES_SELECTIVE, FORWARD_CAN, GET_MCCONF = 0, 4, 50, 34, 14

#: Bits of the mask of a selective request, in the order of `VALUES`.
MOTOR_CURRENT, IQ, DUTY, ERPM, V_IN, TACHOMETER, PID_POS, VQ = (1 << bit for bit in (2, 5, 6, 7, 8, 13, 16, 20))
_FAULT, _CONTROLLER_ID = 1 << 15, 1 << 17
#: What every poll asks for; with and without two fields of a byte, so that the mask, which the drive sends back, tells
#: the answers of four requests in a row apart.
POLL_MASKS = tuple(
    IQ | DUTY | ERPM | V_IN | TACHOMETER | PID_POS | VQ | byte
    for byte in (0, _FAULT, _CONTROLLER_ID, _FAULT | _CONTROLLER_ID)
)
#: What a seldom poll asks for: one average more, see `coverage`.
CHECK_MASK = POLL_MASKS[0] | MOTOR_CURRENT

#: Payloads that may leave, by what they ask; forwarded to a drive behind this one, `FORWARD_CAN` and its id come first.
MAY_SEND: dict[str, tuple[bytes, ...]] = {
    "the firmware's version": (bytes([FW_VERSION]),),
    "a selection of values": tuple(
        bytes([GET_VALUES_SELECTIVE]) + mask.to_bytes(4, "big") for mask in (*POLL_MASKS, CHECK_MASK)
    ),
    "the motor's configuration (by scan, once)": (bytes([GET_MCCONF]),),
}


def request(payload: bytes, can_id: int | None = None) -> bytes:
    """The packet of one of `MAY_SEND`, for the drive on the line or the one with this id on its CAN bus.

    Raises:
        ValueError: the payload is none of them.
    """
    if not any(payload in payloads for payloads in MAY_SEND.values()):
        raise ValueError(f"{payload.hex()} may not be sent to a VESC")
    return encode_packet(payload if can_id is None else bytes([FORWARD_CAN, can_id]) + payload)
