"""Connections of a web server whose request has not arrived as a whole: they hold no thread."""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

__all__ = ["PendingConnections", "environ_of"]

LONGEST_HEADER = 16_384  # bytes
LONGEST_BODY = 1_000_000  # bytes; of a longer one the server says so
WHOLE = 65_536  # bytes of what follows the header that are waited for here
END = b"\r\n\r\n"
ROOM = 256  # connections that may wait at a time; of more the oldest are closed
DEADLINE = 10.0  # seconds within which a request has to be there as a whole
LONGEST = 30.0  # seconds within which it has to be answered
TICK = 0.02  # seconds between two looks at who waits


class PendingConnections:
    """Connections that wait until their request has arrived; then a thread serves them.

    A connection that sends a byte now and then is closed at a deadline. One without permission is
    answered and closed at once.

    Parameters
    ----------
    serve
        Function that serves a connection of cheroot whose request has arrived.
    refusal
        Function of the header of a request, as `environ_of` returns it, that returns the reason of
        a refusal; empty: the request is served.
    timeout
        Seconds that reading and writing may take where a connection is served.
    """

    def __init__(
        self,
        serve: Callable[[Any], None],
        refusal: Callable[[Mapping[str, str]], str],
        timeout: float,
    ) -> None:
        self._serve, self._refusal, self._timeout = serve, refusal, timeout
        self._waiting: dict[Any, float] = {}
        self._served: dict[Any, float] = {}
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def admit(self, connection: Any) -> None:
        """Take a connection from which something has come, or will."""
        with self._changed:
            while len(self._waiting) >= ROOM:
                oldest = next(iter(self._waiting))
                del self._waiting[oldest]
                _close(oldest)
            self._waiting[connection] = time.monotonic()
            self._changed.notify()

    def close(self) -> None:
        """Send all away."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        for connection in self._waiting:
            _close(connection)

    def _watch(self) -> None:
        while True:
            with self._changed:
                # Sockets are polled only while somebody waits or is served.
                idle = not (self._waiting or self._served)
                self._changed.wait(None if idle and not self._closed else TICK)
                if self._closed:
                    return
                waiting = [*self._waiting.items()]
            for connection, since in waiting:
                if self._done(connection, since):
                    with self._changed:
                        self._waiting.pop(connection, None)
            self._end_late()

    def _done(self, connection: Any, since: float) -> bool:
        """Look at a visitor; return whether he need not wait any more."""
        try:
            content = self._seen(connection.socket)
        except OSError:
            content = b""
        if content == b"":  # gone
            _close(connection)
            return True
        # Bytes that come one by one do not move the deadline.
        if content is None or not _whole(content):
            if time.monotonic() - since > DEADLINE:
                _close(connection)
                return True
            return False
        why = self._refusal(environ_of(content))
        if why:
            _answer(connection.socket, why)
            _close(connection)
        else:
            self._hand_on(connection)
        return True

    def _seen(self, visitor: socket.socket) -> bytes | None:
        """Return the received bytes without consuming them, None if none have come."""
        visitor.setblocking(False)
        try:
            return visitor.recv(LONGEST_HEADER + WHOLE, socket.MSG_PEEK)
        except BlockingIOError:
            return None
        finally:
            visitor.settimeout(self._timeout)

    def _hand_on(self, connection: Any) -> None:
        communicate = type(connection).communicate

        def watched() -> Any:
            with self._changed:
                self._served[connection] = time.monotonic()
                self._changed.notify()
            try:
                return communicate(connection)
            finally:
                with self._changed:
                    self._served.pop(connection, None)

        connection.communicate = watched
        self._serve(connection)

    def _end_late(self) -> None:
        """End connections that hold a thread for too long, by reading or writing slowly."""
        with self._changed:
            late = [c for c, since in self._served.items() if time.monotonic() - since > LONGEST]
        for connection in late:
            with suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)


def environ_of(content: bytes) -> dict[str, str]:
    r"""Return the query string and the headers of a request, under their names in WSGI.

    >>> environ_of(b"GET /health?token=a HTTP/1.1\r\nHost: localhost\r\n\r\n")
    {'QUERY_STRING': 'token=a', 'HTTP_HOST': 'localhost'}
    """
    first, *lines = content.partition(END)[0].decode("latin-1").split("\r\n")
    target = first.split(" ")[1] if first.count(" ") >= 2 else ""
    found = {"QUERY_STRING": target.partition("?")[2]}
    for line in lines:
        name, _, value = line.partition(":")
        key = "HTTP_" + name.strip().upper().replace("-", "_")
        found[key] = f"{found[key]},{value.strip()}" if key in found else value.strip()
    return found


def _whole(content: bytes) -> bool:
    """Return whether a request is there as a whole, or is too long to wait for more of it."""
    head, end, body = content.partition(END)
    if not end:
        return len(content) >= LONGEST_HEADER
    length = re.search(rb"\r\ncontent-length:[ \t]*([0-9]{1,9})[ \t]*(?:\r\n|$)", head, re.I)
    if length is None or int(length[1]) > LONGEST_BODY:
        return True
    return len(body) >= min(int(length[1]), WHOLE)


def _answer(visitor: socket.socket, why: str) -> None:
    """Send the reason of a refusal with code 403, without waiting for a slow client."""
    text = f"{why}\n".encode()
    head = (
        "HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\n"
        f"Content-Length: {len(text)}\r\nConnection: close\r\n\r\n"
    )
    with suppress(OSError):
        visitor.setblocking(False)
        visitor.send(head.encode() + text)
        visitor.shutdown(socket.SHUT_WR)
        visitor.recv(LONGEST_HEADER + WHOLE)  # what was not read would cut the answer off


def _close(connection: Any) -> None:
    with suppress(OSError):
        connection.close()
