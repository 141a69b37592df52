"""Deadlines for the connections of a web server (waitress), which holds a thread only to answer."""

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

Refusal: TypeAlias = Callable[[Mapping[str, Any]], str]  # of a header, as WSGI has it

THREADS = 16  # answers that are computed at a time
ROOM = 256  # connections at a time; of more the oldest idle one is closed
LONGEST_HEADER = 16_384  # bytes
LONGEST_BODY = 1_000_000  # bytes
IN_MEMORY = 65_536  # bytes of a body; the rest of it is in a temporary file
DEADLINE = 10  # seconds within which a request has to be there as a whole
LONGEST = 30  # seconds within which its answer has to be taken


class Discarded(io.BytesIO):
    """A body that is not kept."""

    def append(self, data: bytes) -> None:
        return

    def getfile(self) -> io.BytesIO:
        return self

    def __len__(self) -> int:
        return 0


class Request(HTTPRequestParser):  # type: ignore[misc]
    """A request whose body is not stored if its header is refused: unknown clients fill no disk."""

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
    """A connection that remembers when its last request began."""

    begun = 0.0

    def parser_class(self, adj: Any) -> Request:
        return Request(adj, self.server.refusal)

    def received(self, data: bytes) -> Any:
        """Take received bytes; bytes that come one by one do not move the deadline."""
        if self.request is None:
            self.begun = time.time()
        return super().received(data)

    def handle_close(self) -> None:
        """Close the connection, and the file that holds a part of its request."""
        if self.request is not None:
            self.request.close()
        super().handle_close()


class Listener(TcpWSGIServer):  # type: ignore[misc]
    """A server that closes connections after a deadline, and the oldest idle ones for new ones."""

    channel_class = Visitor
    refusal: Refusal

    def maintenance(self, now: float) -> None:
        """Close connections that are idle, ask too slowly, or take their answer too slowly."""
        super().maintenance(now)
        for visitor in [*self.active_channels.values()]:
            since = now - visitor.begun
            asking, answered = visitor.request is not None, visitor.total_outbufs_len > 0
            if (asking and since > DEADLINE) or (answered and since > LONGEST):
                # With `will_close` it would be closed only once it has taken more of its answer. A
                # socket that is closed here is polled once more, when a new connection may have
                # its number already and would be closed in its place.
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
        """Close all sockets in the thread that polls them, which ends without any."""

        def end() -> None:
            for visitor in [*self.active_channels.values()]:
                visitor.handle_close()
            self.trigger.del_channel(self._map)
            wasyncore.close_all(self._map)

        self.trigger.pull_trigger(end)

    def close(self) -> None:
        """Close the listening socket; the trigger stays open for those who may be pulling it."""
        wasyncore.dispatcher.close(self)

    def release(self) -> None:
        """End the threads that answer, and close the trigger that they pull; after `run`."""
        self.task_dispatcher.shutdown()
        if not self.task_dispatcher.threads:
            self.trigger.close()


def listener(application: WSGIApplication, place: socket.socket, refusal: Refusal) -> Listener:
    """Return a server that listens at a bound socket; its `run` serves.

    `refusal`: function of a header that returns why the application will refuse it; empty if it
    will not.
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
