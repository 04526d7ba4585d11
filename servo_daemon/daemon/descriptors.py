"""File descriptors: enough of them for state files and drives' ports, whatever clients the API has."""

from __future__ import annotations

import logging
import sys

log = logging.getLogger(__name__)

#: For what is not a connection of the API: interpreter, libraries, event loop, logs, the state being saved, a diagnosis
#: (measured: 30 with one drive), and for each drive a port with its pipes.
_OWN, _A_DRIVE = 96, 8
#: So many are asked for where the system gives more than it gives unasked.
_WANTED = 4096
#: Connections that are taken whatever the system gives: a browser opens six to one host.
_FEWEST = 8


def room_for_connections(drives: int, most: int) -> int:
    """How many connections the API may hold. The soft limit of descriptors is raised as far as it is allowed to be.

    Args:
        drives: configured.
        most: connections that are wanted.
    """
    if sys.platform == "win32":
        return most
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _WANTED if hard == resource.RLIM_INFINITY else min(_WANTED, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    if soft == resource.RLIM_INFINITY:
        return most
    room = soft - _OWN - _A_DRIVE * drives
    if room < most:
        room = max(_FEWEST, room)
        log.warning(
            "only %d file descriptors: the API holds %d connections at most (LimitNOFILE, ulimit -n)", soft, room
        )
    return min(most, room)
