"""A running daemon, read from Python: `pip install 'servo-daemon[client]'`.

    from servo_daemon.client import Client

    with Client("http://127.0.0.1:8077") as daemon:
        print(daemon.estimates("axis1")["R"])
        year = daemon.history("axis1", "R", "K", window="1y").to_pandas()

`AsyncClient` has the same methods to be awaited.
"""

try:
    import httpx as _httpx  # noqa: F401
except ImportError as error:
    raise ImportError("servo_daemon.client needs httpx: pip install 'servo-daemon[client]'") from error

from servo_daemon.client.awaited import AsyncClient
from servo_daemon.client.clients import Client
from servo_daemon.client.errors import DaemonError, UnreachableError
from servo_daemon.client.records import (
    Capture,
    Diagnosis,
    Estimates,
    Event,
    History,
    Model,
    Parameter,
    Samples,
    Series,
)

__all__ = [
    "AsyncClient",
    "Capture",
    "Client",
    "DaemonError",
    "Diagnosis",
    "Estimates",
    "Event",
    "History",
    "Model",
    "Parameter",
    "Samples",
    "Series",
    "UnreachableError",
]
