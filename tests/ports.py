"""Reserved ports for test servers."""

import socket


def kept_port() -> tuple[socket.socket, int]:
    """Return a socket that reserves a free port against other programs, and the port.

    The socket does not listen, so a server can listen on this port, also after a restart.
    """
    kept = socket.socket()
    kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    kept.bind(("127.0.0.1", 0))
    return kept, kept.getsockname()[1]
