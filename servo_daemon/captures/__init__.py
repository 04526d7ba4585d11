"""Captures: recorded samples in a file (CSV, gzipped CSV, Parquet), read, checked and written.

Depends on `samples` and `errors` only, so that every command, driver and test can read the same files.
"""

from servo_daemon.captures.model import Axis, Capture
from servo_daemon.captures.read import read_capture
from servo_daemon.captures.write import CaptureWriter, write_capture

__all__ = ["Axis", "Capture", "CaptureWriter", "read_capture", "write_capture"]
