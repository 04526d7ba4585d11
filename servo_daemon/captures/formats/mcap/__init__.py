"""MCAP, the container of ROS 2 and Foxglove (https://mcap.dev/spec), by the library `mcap`, an optional extra."""

from typing import Final

#: The first bytes of a file.
MAGIC: Final = b"\x89MCAP0\r\n"
#: The name of our own schema: an object a sample, with a capture's columns.
OURS: Final = "servo_daemon.Sample"
