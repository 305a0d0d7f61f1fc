"""The door of the viewer: which requests may load its page and open its WebSocket.

A browser lets the pages of every site send requests to a server on this machine, and viser answers them all. Here each
request needs the secret that is part of the printed address, and the browser's word that it comes from the page itself.
"""

from __future__ import annotations

import contextlib
import http
import ipaddress
import logging
import secrets
import socket
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from ...schemas import UsageError
from .client_page import with_whole_corners

TIMEOUT_S = 10.0
"""Maximum time of the trial whether the door is closed [s]."""
_LOGGER = logging.getLogger("cgwm.view.requests")
_LOGGER.setLevel(logging.CRITICAL)  # what strangers send is no matter for the user's terminal


class Door:
    """Rules for the requests to one server.

    Args:
        host: Address that the server listens on.
    """

    def __init__(self, host: str) -> None:
        self.secret = secrets.token_urlsafe(24)
        self._local = is_loopback(host)

    def refusal(self, path: str, hosts: Sequence[str], origins: Sequence[str]) -> str:
        """Return the reason to refuse a request, empty for none.

        Args:
            path: Path of the request.
            hosts: Values of its header `Host`.
            origins: Values of its header `Origin`, which browsers send with every WebSocket.
        """
        if len(hosts) != 1 or len(origins) > 1:
            return "one Host and at most one Origin are needed"
        if self._local and not is_loopback(_name(hosts[0])):
            return f"the server is on this machine, not on {hosts[0]}"  # a name that a stranger points here
        if origins and origins[0].partition("://")[2] != hosts[0]:
            return f"requests of pages of {origins[0]} are refused"
        first = path.partition("?")[0].split("/")[1:2]
        if not secrets.compare_digest("".join(first).encode(), self.secret.encode()):
            return "the address that 'cgwm view' has printed is needed"
        return ""

    def inside(self, path: str) -> str:
        """Return the path of an accepted request without the secret."""
        return path.removeprefix(f"/{self.secret}") or "/"


@contextlib.contextmanager
def guarded(door: Door, host: str) -> Iterator[None]:
    """Put a door before the server that is started inside the block on a host with `websockets`.

    viser has no hook for requests. It serves with the public function `serve` of websockets, whose parameter
    `process_request` is one. `require_closed` notices a viser that serves in another way.
    """
    from websockets.asyncio import server  # pyright: ignore[reportMissingImports]

    serve = server.serve

    def serve_behind_door(handler: Any, at: Any = None, number: Any = None, **options: Any) -> Any:
        if at == host:
            options["process_request"] = _checked(door, options.get("process_request"))
            options["logger"] = _LOGGER
        return serve(handler, at, number, **options)

    server.serve = serve_behind_door
    try:
        yield
    finally:
        server.serve = serve


def require_closed(host: str, port: int) -> None:
    """Try the door of a server: a request without the secret has to be refused.

    Raises:
        UsageError: If it is not, so that any page could read what is shown.
    """
    lines = (
        "GET / HTTP/1.1",
        f"Host: localhost:{port}",
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    )
    to = {"0.0.0.0": "127.0.0.1", "::": "::1", "": "localhost"}.get(host, host)
    try:
        with socket.create_connection((to, port), TIMEOUT_S) as connection:
            connection.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
            answer = connection.recv(64)
    except OSError as error:
        answer = str(error).encode()
    if b" 403 " not in answer.split(b"\r\n")[0]:
        raise UsageError(
            "this version of viser cannot be kept from showing the scene to every page that is open in a browser "
            f"(found {answer.decode(errors='replace').splitlines()[:1]}).",
            "viser 1.1.",
            "pip install 'viser>=1.1,<1.2'.",
        )


def is_loopback(host: str) -> bool:
    """Return whether a host is reached from this machine only.

    >>> is_loopback("localhost"), is_loopback("127.0.0.1"), is_loopback("::1"), is_loopback("0.0.0.0")
    (True, True, True, False)
    """
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    return host.lower().rstrip(".") == "localhost" or host.lower().endswith(".localhost")


def _name(host: str) -> str:
    """Return the name in a header `Host`, without its port."""
    return host.partition("]")[0] if host.startswith("[") else host.partition(":")[0]


def _checked(door: Door, answer: Callable[[Any, Any], Any] | None) -> Callable[[Any, Any], Any]:
    """Return a function that refuses requests, and lets others be answered without the secret in their paths."""

    def check(connection: Any, request: Any) -> Any:
        headers = request.headers
        reason = door.refusal(request.path, headers.get_all("Host"), headers.get_all("Origin"))
        if reason:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"Refused: {reason}.\n")
        request.path = door.inside(request.path)
        if answer is None or headers.get("Upgrade") == "websocket":
            return answer and answer(connection, request)
        with contextlib.suppress(KeyError):
            del headers["Accept-Encoding"]  # the page is changed below
        return _mended(answer(connection, request))

    return check


def _mended(response: Any) -> Any:
    """Return a response with the page of viser with whole corners of splats; others as they are."""
    body = getattr(response, "body", None)
    if body:
        response.body = with_whole_corners(body)
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))
    return response
