"""Captures: recorded samples in a file, read, checked and written.

CSV, gzipped CSV and Parquet both ways; MAT, Excel, MDF and CAN logs to read, with a signal map. Depends on `samples`,
`errors` and, for formulas, counters that wrap and CAN logs, on the CAN driver's decoders, so that every command, driver
and test can read the same files.
"""

from servo_daemon.captures.capture.model import Axis, Capture
from servo_daemon.captures.capture.order import in_canonical_order, without_copies
from servo_daemon.captures.columns.signal_map import SignalMap, load_signal_map
from servo_daemon.captures.read import read_capture
from servo_daemon.captures.write import CaptureWriter, write_capture

__all__ = [
    "Axis",
    "Capture",
    "CaptureWriter",
    "SignalMap",
    "in_canonical_order",
    "load_signal_map",
    "read_capture",
    "without_copies",
    "write_capture",
]
