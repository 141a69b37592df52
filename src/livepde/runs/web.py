"""Web server of a run, for clients on this machine or clients with a token."""

from __future__ import annotations

import hmac
import ipaddress
import logging
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from livepde.errors import RunError, optional

if TYPE_CHECKING:
    from wsgiref.types import StartResponse, WSGIApplication, WSGIEnvironment

COOKIE = "livepde_token"
SHORTEST_TOKEN = 16  # characters of a token if other machines can reach the server
NOT_HERE = "this page is for this machine only: use localhost"
NO_TOKEN = "add the ?token=... that was printed when the server started"
HEADERS = [
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
    ("Referrer-Policy", "no-referrer"),  # an address may contain a token
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
    """Address of a server, and the token that its clients must have.

    A client sends the token as `?token=...` once, or in the header `Authorization: Bearer ...`. The
    token is optional on a loopback address. On any other address, a token is generated if none is
    specified.
    """

    host: str = "127.0.0.1"
    port: int = 0  # 0: any free port
    token: str = field(default="", repr=False)
    made: bool = field(default=False, init=False)  # whether the token was generated

    def __post_init__(self) -> None:
        alone = _loopback(self.host)
        # Other machines can reach any interface but loopback, so that a token is required.
        if not self.token and not alone:
            object.__setattr__(self, "token", secrets.token_urlsafe(24))
            object.__setattr__(self, "made", True)
        if not re.fullmatch(r"[A-Za-z0-9._~-]*", self.token):
            raise RunError("A token may contain letters, digits and '-', '_', '.', '~' only.")
        if self.token and not alone and len(self.token) < SHORTEST_TOKEN:
            raise RunError(
                f"A token for other machines needs at least {SHORTEST_TOKEN} characters; "
                "if it is left out, one is generated."
            )

    @classmethod
    def read(cls, text: str, port: int, token: str = "") -> Address:
        """Parse the address of a user: HOST, HOST:PORT, PORT or an empty string."""
        host, _, number = text.rpartition(":") if ":" in text else ("", "", text)
        # The last part of a name or of an IPv6 address is not a port.
        if number and not number.isdigit():
            host, number = text, ""
        if number and (len(number) > 5 or int(number) > 65535):
            raise RunError(f"'{text}' is not an address: a port is a number up to 65535.")
        return cls(host or cls.host, int(number) if number else port, token)


class Server:
    """Server of a WSGI application, in its own threads.

    `url`: address of the server, with the token.
    `shown`: address to print or log. It contains the token only if it was generated here, since the
    user cannot know it otherwise.
    Raises `RunError`: the port is taken, or waitress is not installed.
    """

    def __init__(self, application: WSGIApplication, address: Address) -> None:
        with optional("service", "Serving needs waitress", RunError):
            from livepde.runs.visitors import listener
        host, port = address.host, address.port
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            place = socket.create_server((host, port), family=family)
        except OSError as error:
            reason = error.strerror or error
            raise RunError(
                f"Cannot listen on {host}:{port}: {reason}; choose another port."
            ) from error
        # waitress warns of each request that waits for a thread.
        logging.getLogger("waitress.queue").setLevel(logging.ERROR)
        served = _headed(application, address)
        self._server = listener(served, place, lambda header: _why_not(header, address))
        # Threads started by a daemon thread are daemons too: none prevents the program from ending.
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._thread.start()
        self.port = int(place.getsockname()[1])
        named = f"[{host}]" if ":" in host else host
        plain = f"http://{named}:{self.port}/"
        self.url = f"{plain}?token={address.token}" if address.token else plain
        self.shown = self.url if address.made else plain

    def wait(self) -> None:
        """Block until the server is closed."""
        self._thread.join()

    def close(self) -> None:
        """Stop the server and its threads."""
        if self._thread.is_alive():
            self._server.stop()
            self._thread.join()
            self._server.release()


def _headed(application: WSGIApplication, address: Address) -> WSGIApplication:
    """Wrap an application: check tokens, add headers, and set a cookie for the token."""

    def answer(environ: WSGIEnvironment, begin: StartResponse) -> Iterable[bytes]:
        if why := _why_not(environ, address):
            begin("403 Forbidden", [("Content-Type", "text/plain")])
            return [f"{why}\n".encode()]
        given = _given(environ)
        known = bool(address.token) and _same(given, address.token)
        cookie = f"{COOKIE}={given}; HttpOnly; SameSite=Strict; Path=/"
        more = [("Set-Cookie", cookie)] if known else []
        return application(environ, _adding(begin, HEADERS + more))

    return answer


def _why_not(environ: Mapping[str, Any], address: Address) -> str:
    """Return why a request with this header is refused, or an empty string."""
    if not address.token:
        # Against DNS rebinding: a foreign page may map its own host name to this machine.
        return "" if _loopback(_host(environ)) else NOT_HERE
    tokens = [_given(environ), *_known(environ)]
    return "" if any(_same(token, address.token) for token in tokens) else NO_TOKEN


def _given(environ: Mapping[str, Any]) -> str:
    return parse_qs(str(environ.get("QUERY_STRING", ""))).get("token", [""])[0]


def _host(environ: Mapping[str, Any]) -> str:
    host = str(environ.get("HTTP_HOST") or environ.get("SERVER_NAME", ""))
    # An IPv6 address is in brackets before the port.
    if host.startswith("["):
        return host.partition("]")[0].strip("[")
    return host.partition(":")[0]


def _known(environ: Mapping[str, Any]) -> list[str]:
    """Return the tokens in the headers of a request: as authorization or as cookies."""
    found = [str(environ.get("HTTP_AUTHORIZATION", "")).removeprefix("Bearer ").strip()]
    try:
        cookie = SimpleCookie(str(environ.get("HTTP_COOKIE", "")))
    except CookieError:
        return found
    return found + [morsel.value for name, morsel in cookie.items() if name == COOKIE]


def _same(given: str, token: str) -> bool:
    return bool(given) and hmac.compare_digest(given.encode(), token.encode())


def _adding(start: StartResponse, more: list[tuple[str, str]]) -> Any:
    """Wrap a `start_response` of WSGI to add headers."""

    def begin(status: str, headers: list[tuple[str, str]], *rest: Any) -> Callable[[bytes], object]:
        return start(status, [*headers, *more], *rest)

    return begin
