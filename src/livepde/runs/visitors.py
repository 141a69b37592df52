"""Web server (waitress) with deadlines for connections, which use threads only for answers."""

from __future__ import annotations

import io
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeAlias

from waitress import wasyncore
from waitress.channel import HTTPChannel
from waitress.parser import HTTPRequestParser
from waitress.server import TcpWSGIServer

if TYPE_CHECKING:
    from wsgiref.types import WSGIApplication

Refusal: TypeAlias = Callable[[Mapping[str, Any]], str]  # the argument is a header, as in WSGI

THREADS = 16  # concurrent answers
ROOM = 256  # concurrent connections; for a new one beyond these, the oldest idle one is closed
LONGEST_HEADER = 16_384  # bytes
LONGEST_BODY = 1_000_000  # bytes
IN_MEMORY = 65_536  # bytes up to which a body is kept in memory; a longer one is in a file
DEADLINE = 10  # seconds until a request must be complete
LONGEST = 30  # seconds since the start of the request until its answer must be read


class Discarded(io.BytesIO):
    """A request body that is not stored."""

    def append(self, data: bytes) -> None:
        return

    def getfile(self) -> io.BytesIO:
        return self

    def __len__(self) -> int:
        return 0


class Request(HTTPRequestParser):  # type: ignore[misc]
    """A request that stores no body if its header is refused, so that no client fills the disk."""

    def __init__(self, adj: Any, refusal: Refusal) -> None:
        super().__init__(adj)
        self._refusal = refusal

    def parse_header(self, header_plus: bytes) -> None:
        super().parse_header(header_plus)
        if self.body_rcv is not None:
            header = {f"HTTP_{name}": value for name, value in self.headers.items()}
            if self._refusal({"QUERY_STRING": self.query, **header}):
                self.body_rcv.buf = Discarded()


class Visitor(HTTPChannel):  # type: ignore[misc]
    """A connection that records when its last request began."""

    begun = 0.0

    def parser_class(self, adj: Any) -> Request:
        return Request(adj, self.server.refusal)

    def received(self, data: bytes) -> Any:
        """Process received bytes; only the first bytes of a request set its deadline."""
        if self.request is None:
            self.begun = time.time()
        return super().received(data)

    def handle_close(self) -> None:
        """Close the connection, and the temporary file of an incomplete request."""
        if self.request is not None:
            self.request.close()
        super().handle_close()


class Listener(TcpWSGIServer):  # type: ignore[misc]
    """A server that closes connections at a deadline, and the oldest idle one for a new one."""

    channel_class = Visitor
    refusal: Refusal

    def maintenance(self, now: float) -> None:
        """Close connections that are idle, or too slow to send a request or to read its answer."""
        super().maintenance(now)
        for visitor in [*self.active_channels.values()]:
            since = now - visitor.begun
            asking, answered = visitor.request is not None, visitor.total_outbufs_len > 0
            if (asking and since > DEADLINE) or (answered and since > LONGEST):
                # With `will_close` the connection would be closed only after it reads more of its
                # answer. If the socket were closed here, it would be polled once more, and a new
                # connection with the same file descriptor would be closed instead.
                with suppress(OSError):
                    visitor.socket.shutdown(socket.SHUT_RDWR)

    def handle_accept(self) -> None:
        if len(self.active_channels) >= ROOM:
            for visitor in self.active_channels.values():  # the oldest come first
                if not (visitor.requests or visitor.total_outbufs_len or visitor.will_close):
                    visitor.will_close = True
                    break
        super().handle_accept()

    def stop(self) -> None:
        """Close all sockets in the thread that polls them, which ends that thread."""

        def end() -> None:
            for visitor in [*self.active_channels.values()]:
                visitor.handle_close()
            self.trigger.del_channel(self._map)
            wasyncore.close_all(self._map)

        self.trigger.pull_trigger(end)

    def close(self) -> None:
        """Close the listening socket, but not the trigger, which threads may still pull."""
        wasyncore.dispatcher.close(self)

    def release(self) -> None:
        """End the threads that answer, and close their trigger; to be called after `run`."""
        self.task_dispatcher.shutdown()
        if not self.task_dispatcher.threads:
            self.trigger.close()


def listener(application: WSGIApplication, place: socket.socket, refusal: Refusal) -> Listener:
    """Return a server that listens at a bound socket; its method `run` serves.

    `refusal`: function that returns why the application refuses a request with this header, or an
    empty string.
    """
    server = Listener(
        application,
        _sock=place,
        bind_socket=False,
        sockinfo=(place.family, place.type, place.proto, place.getsockname()),
        threads=THREADS,
        ident=None,
        connection_limit=2 * ROOM,
        channel_timeout=DEADLINE,
        cleanup_interval=1,
        inbuf_overflow=IN_MEMORY,
        max_request_header_size=LONGEST_HEADER,
        max_request_body_size=LONGEST_BODY,
        log_socket_errors=False,
        asyncore_use_poll=True,
    )
    server.refusal = refusal
    return server
