"""Who may open the viewer, and what they may send: all rules of its security.

* The Origin, which browsers send with every WebSocket, must be the server's own: "http://" and the Host. Programs that
  are not browsers send none; no page of another server can make them connect.
* On a loopback address the Host must be "localhost" or a loopback address. A name that somebody lets lead to 127.0.0.1
  (DNS rebinding) is its own Host and Origin, and is refused by this rule.
* On any other address each request needs the token: in the URL, or in the cookie that the page's response sets.
* Messages of other kinds than the viewer's panels and canvas send, and large ones, are dropped: viser's client knows
  uploads and public tunnels, too.

Who passes these rules is trusted: nothing bounds how much a browser asks for.
"""

import contextlib
import hmac
import http
import ipaddress
import logging
import secrets
import socket
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server as web
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

if TYPE_CHECKING:
    import viser
    import viser.infra

TOKEN_BYTES = 24  # 192 bits
MAX_MESSAGE_BYTES = 2**16  # of one message of a browser; the largest that the panels send has a few hundred
CLOSE_SECONDS = 2.0  # in which a client must answer a farewell
ACCEPTED = {"ViewerCameraMessage", "GuiUpdateMessage", "SceneNodeClickMessage", "ScenePointerMessage"}
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'self'",  # no page of another server shows the viewer in a frame
    "Referrer-Policy": "no-referrer",  # the token is in the URL
}
log = logging.getLogger(__name__)

Process: TypeAlias = Callable[[ServerConnection, Request], Response | None]
Handler: TypeAlias = Callable[[ServerConnection], Awaitable[None]]


def is_loopback(address: str) -> bool:
    """Whether a numeric address leads to this machine only; False for a name."""
    try:
        numeric = ipaddress.ip_address(address)
    except ValueError:
        return False
    mapped = numeric.ipv4_mapped if isinstance(numeric, ipaddress.IPv6Address) else None
    return (mapped or numeric).is_loopback


def authority(text: str) -> tuple[str, int] | None:
    """Split "host" or "host:port" into the host in lower case and the port, 80 by default; None for other text."""
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    if not host or parts.netloc != text or "@" in text:
        return None
    return host, 80 if port is None else port


@dataclass(frozen=True)
class Access:
    """Rules on the requests of a server: each must hold the token; on a loopback address there is none."""

    token: str = ""

    @staticmethod
    def to(address: str) -> "Access":
        """Return the rules for a server that listens on this numeric address, with a random token if it needs one."""
        return Access("" if is_loopback(address) else secrets.token_urlsafe(TOKEN_BYTES))

    def refusal(self, target: str, headers: Headers) -> str | None:
        """Return why a request for `target`, such as "/?token=...", is refused, for its sender; None if it may pass."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        host = authority(hosts[0]) if len(hosts) == 1 else None
        if host is None:
            return "the request needs one header Host: expected the address of the viewer"
        if not self.token and host[0] != "localhost" and not is_loopback(host[0]):
            return "the viewer serves this machine only: expected http://localhost or http://127.0.0.1 in the address"
        for origin in origins:
            scheme, _, own = origin.partition("://")
            if len(origins) > 1 or scheme != "http" or authority(own) != host:
                return "the request comes from a page of another server: expected the viewer's own page"
        cookies = (pair.strip() for line in headers.get_all("Cookie") for pair in line.split(";"))
        kept = f"{_cookie_name(host[1])}={self.token}"
        if self.token and not (self._in_url(target) or any(_same(cookie, kept) for cookie in cookies)):
            return "the viewer needs its token: open the address with ?token=, as nexwarp has printed it"
        return None

    def cookie(self, target: str, headers: Headers) -> str | None:
        """Return the cookie for the response to an admitted page request with the token in its URL; else None."""
        host = authority(headers.get_all("Host")[0])
        if not self.token or host is None or not self._in_url(target):
            return None
        return f"{_cookie_name(host[1])}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _in_url(self, target: str) -> bool:
        return _same(parse_qs(target.partition("?")[2]).get("token", [""])[0], self.token)


def _same(text: str, secret: str) -> bool:
    """Compare in constant time."""
    return hmac.compare_digest(text.encode("utf-8", "surrogateescape"), secret.encode())


def _cookie_name(port: int) -> str:
    """Cookies of a host are shared by its ports; each viewer has one of its own."""
    return f"nexwarp_{port}"


class Gate:
    """Admits requests by the rules of access."""

    def __init__(self, access: Access) -> None:
        self.access = access
        self.attached = False  # viser's server runs behind this gate
        self.is_open = False  # requests are answered

    @contextlib.contextmanager
    def before_viser(self, listener: socket.socket) -> Iterator[None]:
        """Inside the context, put the gate before the server that viser starts, and let it serve on a socket.

        viser has no public way to do so.
        """
        serve = web.serve

        # viser's own arguments: its handler of WebSockets and its pages as `process_request`.
        def guarded(handler: Handler, _host: str, _port: int, *, process_request: Process, **options: Any) -> web.serve:
            self.attached = True
            options |= {"max_size": MAX_MESSAGE_BYTES, "close_timeout": CLOSE_SECONDS}
            answer = partial(self._answer, process_request)
            return serve(handler, sock=listener, process_request=answer, **options)

        web.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            web.serve = serve  # type: ignore[misc]

    def _answer(self, pages: Process, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse a request, or answer it with a page, or return None to admit a WebSocket."""
        if not self.is_open:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "the viewer is starting: reload this page\n")
        reason = self.access.refusal(request.path, request.headers)
        if reason is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
        response = pages(connection, request)
        if response is None:
            return None
        for name, value in HEADERS.items():
            response.headers[name] = value
        if (cookie := self.access.cookie(request.path, request.headers)) is not None:
            response.headers["Set-Cookie"] = cookie
        return response


def accept_only_known(server: "viser.ViserServer") -> None:
    """Drop messages that the viewer does not use, and ignore invalid ones; viser has no public way to do so."""
    server.get_event_loop().set_exception_handler(lambda _loop, context: log.debug("dropped: %s", context))

    def watch(handler: "viser.infra.WebsockMessageHandler") -> None:
        handle = handler._handle_incoming_message

        async def accept(client_id: "viser.infra.ClientId", message: "viser.infra.Message") -> None:
            name = type(message).__name__
            if name in ACCEPTED and (name != "GuiUpdateMessage" or set(getattr(message, "updates", ())) == {"value"}):
                await handle(client_id, message)

        handler._handle_incoming_message = accept  # type: ignore[method-assign]

    watch(server._websock_server)
    server._websock_server.on_client_connect(watch)
