"""Who may open the viewer, how many may, and what they may send: all rules of its security.

* The Origin, which browsers send with every WebSocket, must be the server's own: "http://" and the Host. Programs that
  are not browsers send none; no page of another server can make them connect.
* On a loopback address the Host must be "localhost" or a loopback address. A name that somebody lets lead to 127.0.0.1
  (DNS rebinding) is its own Host and Origin, and is refused by this rule.
* On any other address each request needs the token: in the URL, or in the cookie that the page's response sets.
* Tabs, connections, the size and rate of messages, and the time to read one are bounded. Messages of other kinds than
  the viewer's panels and canvas send are dropped: viser's client knows uploads and public tunnels, too.
"""

import asyncio
import contextlib
import hmac
import http
import ipaddress
import logging
import secrets
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeAlias
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server as web
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

if TYPE_CHECKING:
    import viser
    import viser.infra

TOKEN_BYTES = 24  # 192 bits
MAX_CLIENTS = 32  # browser tabs
MAX_CONNECTIONS = 128  # TCP connections: clients, pages in transfer, and what has not sent a request yet
MAX_MESSAGE_BYTES = 2**16  # of one message of a browser; the largest that the panels send has a few hundred
MESSAGES_A_SECOND = 120.0  # of one client, on average; a browser sends 50 while its camera moves
BURST = 240  # messages of one client that may come at once
FLOOD_SECONDS = 5.0  # of more messages than that, after which a client is closed
SEND_SECONDS = 60.0  # in which a client must have read a message
CLOSE_SECONDS = 2.0  # in which a client must answer a farewell
ACCEPTED = {"ViewerCameraMessage", "GuiUpdateMessage", "SceneNodeClickMessage"}
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
    """Rules on the requests of a server: `local` on a loopback address; else each must hold the token."""

    local: bool
    token: str

    @staticmethod
    def to(address: str) -> "Access":
        """Return the rules for a server that listens on this numeric address, with a random token if it needs one."""
        local = is_loopback(address)
        return Access(local, "" if local else secrets.token_urlsafe(TOKEN_BYTES))

    def refusal(self, target: str, headers: Headers) -> str | None:
        """Return why a request for `target`, such as "/?token=...", is refused, for its sender; None if it may pass."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        host = authority(hosts[0]) if len(hosts) == 1 else None
        if host is None:
            return "the request needs one header Host: expected the address of the viewer"
        if self.local and host[0] != "localhost" and not is_loopback(host[0]):
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
    """Admits requests by the rules of access and up to the largest numbers of connections and clients."""

    def __init__(self, access: Access) -> None:
        self.access = access
        self.connections: dict[Connection, None] = {}  # TCP, the oldest first
        self.clients: set[Connection] = set()  # those of them that are WebSockets
        self.attached = False  # viser's server runs behind this gate
        self.is_open = False  # requests are answered

    @contextlib.contextmanager
    def before_viser(self) -> Iterator[None]:
        """Inside the context, put the gate before the server that viser starts; viser has no public way to do so."""
        serve = web.serve

        # viser's own arguments: its handler of WebSockets and its pages as `process_request`.
        def guarded(
            handler: Handler, host: str, port: int, *, process_request: Process, **options: object
        ) -> web.serve:
            self.attached = True
            options |= {"max_size": MAX_MESSAGE_BYTES, "close_timeout": CLOSE_SECONDS}
            options |= {"create_connection": partial(Connection, self)}
            answer = partial(self._answer, process_request)
            return serve(handler, host, port, process_request=answer, **options)  # type: ignore[arg-type]

        web.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            web.serve = serve  # type: ignore[misc]

    def _answer(self, pages: Process, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse a request, or answer it with a page, or return None to admit a WebSocket."""
        assert isinstance(connection, Connection)
        if not self.is_open:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "the viewer is starting: reload this page\n")
        reason = self.access.refusal(request.path, request.headers)
        if reason is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
        connection.is_admitted = True
        if len(self.clients) >= MAX_CLIENTS:
            text = f"the viewer serves at most {MAX_CLIENTS} browser tabs: close one of them and reload this page\n"
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, text)
        response = pages(connection, request)
        if response is None:
            self.clients.add(connection)
            return None
        for name, value in HEADERS.items():
            response.headers[name] = value
        if (cookie := self.access.cookie(request.path, request.headers)) is not None:
            response.headers["Set-Cookie"] = cookie
        return response


class Connection(ServerConnection):
    """A connection that is read slowly if it sends fast, and closed if it goes on to, or does not read."""

    def __init__(self, gate: Gate, *arguments: object, **options: object) -> None:
        super().__init__(*arguments, **options)  # type: ignore[arg-type]
        self.gate = gate
        self.is_admitted = False  # a request of it has passed the rules of access
        self.sending = 0  # messages that the client has not taken yet
        self.next_due = self.in_time = 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take up a TCP connection. If there are too many, drop the oldest that has not sent a valid request."""
        super().connection_made(transport)
        connections = self.gate.connections
        connections[self] = None
        if len(connections) > MAX_CONNECTIONS:
            dropped = next((other for other in connections if not other.is_admitted), self)
            del connections[dropped]  # it is lost later
            dropped.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a closed connection."""
        self.gate.connections.pop(self, None)
        self.gate.clients.discard(self)
        super().connection_lost(exc)

    async def recv(self, decode: bool | None = None) -> str | bytes:  # type: ignore[override]
        """Wait for a message. A client that sends too fast waits: its connection is not read in the meantime."""
        message = await super().recv(decode)
        now = self.loop.time()
        self.next_due = max(self.next_due, now - BURST / MESSAGES_A_SECOND) + 1.0 / MESSAGES_A_SECOND
        # At least a zero: the previous message is handled before the next one is taken.
        await asyncio.sleep(max(self.next_due - now, 0.0))
        if self.next_due <= now:
            self.in_time = now
        elif now - self.in_time > FLOOD_SECONDS:
            self.transport.abort()
        return message

    async def send(self, message: bytes, text: bool | None = None) -> None:  # type: ignore[override]
        """Send a message; close the connection if it is not read in time."""
        timer = self.loop.call_later(SEND_SECONDS, self.transport.abort)
        self.sending += 1
        try:
            await super().send(message, text)
        finally:
            self.sending -= 1
            timer.cancel()


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
