"""The socket that the API listens on."""

from __future__ import annotations

import errno
import socket

from servo_daemon.errors import ServoDaemonError


def listen(host: str, port: int) -> socket.socket:
    """The API's socket, bound before anything else starts.

    Raises:
        ServoDaemonError: the address is taken or not ours.
    """
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[
            0
        ]
        # asyncio switches Nagle's algorithm off only where it sees the protocol named; else an answer takes 40 ms.
        listener = socket.socket(family, kind, socket.IPPROTO_TCP)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(128)
        except BaseException:
            listener.close()
            raise
        return listener
    except OSError as error:
        reason = error.strerror or str(error)
        taken = error.errno == errno.EADDRINUSE
        hint = "; is another servo-daemon running? --port 0 takes any free one" if taken else ""
        raise ServoDaemonError(f"cannot listen on {host} port {port}: {reason}{hint}") from error
