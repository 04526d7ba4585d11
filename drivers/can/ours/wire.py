"""The numbers of our own CAN frames, as `servo.dbc` and docs/protocol-can.md have them, for decoder and encoder."""

from __future__ import annotations

#: Drive ids on one bus. `servo.dbc` is written for drive 1; drive n adds n - 1 to every identifier. Chosen to stay
#: clear of CANopen's predefined connection set (CiA 301), so that both can share a bus.
FIRST_DRIVE, LAST_DRIVE = 1, 31
SYNC_ID, SAMPLE_ID, DESCRIPTION_ID = 0x101, 0x121, 0x681
WIRE_VERSION = 1
#: A Sync must come at least this often; the drive side sends it more often where its period asks for it.
SYNC_PERIOD_S = 0.05

#: The words of a Sample.
VOLTAGE, CURRENT, POSITION, TIME = range(4)
#: Raw voltage and current that are no number: nothing was measured, and at (or beyond) the end of the range.
NOT_MEASURED, AT_LIMIT = -32_768, 32_767
