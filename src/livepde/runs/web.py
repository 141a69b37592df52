"""Pages and endpoints of a run: served on this machine only, or to whoever knows a token."""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from livepde.errors import RunError
from livepde.runs.pending_connections import LONGEST_BODY, LONGEST_HEADER, ROOM, PendingConnections

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

__all__ = ["Address", "Server"]

COOKIE = "livepde_token"
THREADS = 16  # so many visitors may be slow at a time
TIMEOUT = 5  # seconds that a visitor may be silent within a request
SHORTEST_TOKEN = 16  # characters, where anyone may try
NOT_HERE = "this page is for this machine only: ask for localhost"
NO_TOKEN = "add ?token=... as it was printed where this was started"
HEADERS = [
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
    ("Referrer-Policy", "no-referrer"),  # an address may hold a token
]


def _loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Address:
    """Where to listen, and who may ask.

    Parameters
    ----------
    host, port
        Interface and port; port 0: a free one.
    token
        Secret of each visitor: `?token=...` once, or the header `Authorization: Bearer ...`. On a
        loopback address none is required unless one is given; on any other address one is
        generated if none is given.

    Raises
    ------
    RunError
        A token that does not fit into an address, or is too short for the world outside.
    """

    host: str = "127.0.0.1"
    port: int = 0
    token: str = field(default="", repr=False)
    made: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        alone = _loopback(self.host)
        # Whoever reaches another interface than loopback could ask, so that a token is needed.
        if not self.token and not alone:
            object.__setattr__(self, "token", secrets.token_urlsafe(24))
            object.__setattr__(self, "made", True)
        if not re.fullmatch(r"[A-Za-z0-9._~-]*", self.token):
            raise RunError("A token has letters, digits and '-', '_', '.', '~' only.")
        if self.token and not alone and len(self.token) < SHORTEST_TOKEN:
            raise RunError(
                f"A token for visitors from elsewhere has at least {SHORTEST_TOKEN} characters; "
                "without one a good one is made."
            )

    @classmethod
    def read(cls, text: str, port: int, token: str = "") -> Address:
        """Return the address that a user wrote: HOST, HOST:PORT, PORT or nothing at all."""
        host, _, number = text.rpartition(":") if ":" in text else ("", "", text)
        # The last part of a name or of an IPv6 address is no port.
        if number and not number.isdigit():
            host, number = text, ""
        if number and (len(number) > 5 or int(number) > 65535):
            raise RunError(f"'{text}' is no address: a port is a number up to 65535.")
        return cls(host or cls.host, int(number) if number else port, token)


class Server:
    """A WSGI application, served from threads of its own.

    Parameters
    ----------
    application, address
        The application, and the address to listen on.

    Attributes
    ----------
    url
        Address of the server, with the token.
    shown
        Address to print or log: with the token only if it was generated here, since the user
        cannot know it otherwise.

    Raises
    ------
    RunError
        The port is taken, or the package that serves it is not installed.
    """

    def __init__(self, application: WSGIApplication, address: Address) -> None:
        try:
            from cheroot.wsgi import Server as Cheroot
        except ImportError:
            raise RunError("Serving needs cheroot: pip install 'livepde[service]'.") from None
        place = (address.host, address.port)
        server: Callable[..., Any] = Cheroot
        # cheroot lets five callers wait for its accept(); a sixth would try again after a second.
        self._server = server(
            place, _headed(application, address), numthreads=THREADS, request_queue_size=ROOM
        )
        self._pending = PendingConnections(
            self._server.process_conn, lambda e: _why_not(e, address), TIMEOUT
        )
        self._server.process_conn = self._receive
        self._server.timeout = TIMEOUT
        self._server.max_request_header_size = LONGEST_HEADER
        self._server.max_request_body_size = LONGEST_BODY
        prepared: Future[None] = Future()
        # What a daemon starts is one: no thread that serves keeps a program from its end.
        self._thread = threading.Thread(target=self._serve, args=(place, prepared), daemon=True)
        self._thread.start()
        try:
            prepared.result()
        except OSError as error:
            reason = error.strerror or error
            raise RunError(
                f"Cannot listen on {address.host}:{address.port}: {reason}; choose another port."
            ) from error
        self.port = int(self._server.bind_addr[1])
        host = f"[{address.host}]" if ":" in address.host else address.host
        plain = f"http://{host}:{self.port}/"
        self.url = f"{plain}?token={address.token}" if address.token else plain
        self.shown = self.url if address.made else plain

    def _serve(self, place: tuple[str, int], prepared: Future[None]) -> None:
        try:
            family = socket.AF_INET6 if ":" in place[0] else socket.AF_INET
            # cheroot leaves a socket open if it cannot listen
            socket.create_server(place, family=family).close()
            self._server.prepare()
        except Exception as error:  # noqa: BLE001  it is raised where the server is made
            prepared.set_exception(error)
            return
        prepared.set_result(None)
        self._server.serve()

    def _receive(self, connection: Any) -> None:
        """Hold a connection until its request is complete; close it on pipelined requests."""
        if connection.rfile.has_data():
            connection.close()
        else:
            self._pending.admit(connection)

    def wait(self) -> None:
        """Serve until it is closed."""
        self._thread.join()

    def close(self) -> None:
        """Stop listening."""
        self._pending.close()
        self._server.stop()
        self._thread.join()


def _headed(application: WSGIApplication, address: Address) -> WSGIApplication:
    """Return an application with our headers, and a cookie for visitors with the token."""

    def answer(environ: WSGIEnvironment, begin: StartResponse) -> Iterable[bytes]:
        if why := _why_not(environ, address):  # should the header have been read otherwise before
            begin("403 Forbidden", [("Content-Type", "text/plain"), ("Connection", "close")])
            return [f"{why}\n".encode()]
        given = _given(environ)
        known = bool(address.token) and _same(given, address.token)
        cookie = f"{COOKIE}={given}; HttpOnly; SameSite=Strict; Path=/"
        more = [("Set-Cookie", cookie)] if known else []
        return application(environ, _adding(begin, HEADERS + more))

    return answer


def _why_not(environ: Mapping[str, Any], address: Address) -> str:
    """Return why a request is refused, by its header; empty if it is not."""
    if not address.token:
        # A page elsewhere must not reach this machine under a name of its own.
        return "" if _loopback(_host(environ)) else NOT_HERE
    tokens = [_given(environ), *_known(environ)]
    return "" if any(_same(token, address.token) for token in tokens) else NO_TOKEN


def _given(environ: Mapping[str, Any]) -> str:
    return parse_qs(str(environ.get("QUERY_STRING", ""))).get("token", [""])[0]


def _host(environ: Mapping[str, Any]) -> str:
    host = str(environ.get("HTTP_HOST") or environ.get("SERVER_NAME", ""))
    # An IPv6 address stands in brackets, before the port.
    if host.startswith("["):
        return host.partition("]")[0].strip("[")
    return host.partition(":")[0]


def _known(environ: Mapping[str, Any]) -> list[str]:
    """Return the tokens that a visitor has sent with the request."""
    found = [str(environ.get("HTTP_AUTHORIZATION", "")).removeprefix("Bearer ").strip()]
    try:
        cookie = SimpleCookie(str(environ.get("HTTP_COOKIE", "")))
    except CookieError:
        return found
    return found + [morsel.value for name, morsel in cookie.items() if name == COOKIE]


def _same(given: str, token: str) -> bool:
    return bool(given) and hmac.compare_digest(given.encode(), token.encode())


def _adding(start: StartResponse, more: list[tuple[str, str]]) -> Any:
    """Return a `start_response` of WSGI that adds headers."""

    def begin(status: str, headers: list[tuple[str, str]], *rest: Any) -> Callable[[bytes], object]:
        return start(status, [*headers, *more], *rest)

    return begin
