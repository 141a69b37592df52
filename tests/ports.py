"""Ports of one's own."""

import socket


def kept_port() -> tuple[socket.socket, int]:
    """Return a port that no other program is given, and the socket that keeps it.

    Who asks for this port may listen there, and again after a restart: the socket itself does not.
    """
    kept = socket.socket()
    kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    kept.bind(("127.0.0.1", 0))
    return kept, kept.getsockname()[1]
