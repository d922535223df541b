"""Connections to the web server: who is admitted, how many, how fast they may send, and how long they may not read."""

import asyncio
import contextlib
import http
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from typing import TypeAlias

import websockets.asyncio.server as web
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from nexwarp.viewer.access import Access

MAX_CLIENTS = 32  # browser tabs
MAX_CONNECTIONS = 128  # TCP connections: clients, pages in transfer, and what has not sent a request yet
MAX_MESSAGE_BYTES = 2**16  # of one message of a browser; the largest that the panels send has a few hundred
MESSAGES_A_SECOND = 120.0  # of one client, on average; a browser sends 50 while its camera moves
BURST = 240  # messages of one client that may come at once
FLOOD_SECONDS = 5.0  # of more messages than that, after which a client is closed
SEND_SECONDS = 60.0  # in which a client must have read a message
CLOSE_SECONDS = 2.0  # in which a client must answer a farewell
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'self'",  # no page of another server shows the viewer in a frame
    "Referrer-Policy": "no-referrer",  # the token is in the URL
}

Process: TypeAlias = Callable[[ServerConnection, Request], Response | None]
Handler: TypeAlias = Callable[[ServerConnection], Awaitable[None]]


class Gate:
    """Admits requests by the rules of access and up to the largest numbers of connections and clients."""

    def __init__(self, access: Access) -> None:
        self.access = access
        self.connections: set[Connection] = set()  # TCP
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
            return serve(partial(_handle, handler), host, port, process_request=answer, **options)  # type: ignore[arg-type]

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


async def _handle(handler: Handler, connection: ServerConnection) -> None:
    """Run viser's handler of a WebSocket; close it if it is of another version, of which viser would print a line."""
    import viser

    if connection.subprotocol != f"viser-v{viser.__version__}":
        await connection.close(1002, f"expected a client of viser {viser.__version__}: reload the page")
        return
    await handler(connection)


class Connection(ServerConnection):
    """A connection that is read slowly if it sends fast, and closed if it goes on to, or does not read."""

    def __init__(self, gate: Gate, *arguments: object, **options: object) -> None:
        super().__init__(*arguments, **options)  # type: ignore[arg-type]
        self.gate = gate
        self.sending = 0  # messages that the client has not taken yet
        self.next_due = self.in_time = 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take up a TCP connection, or drop it if there are too many."""
        super().connection_made(transport)
        self.gate.connections.add(self)
        if len(self.gate.connections) > MAX_CONNECTIONS:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a closed connection."""
        self.gate.connections.discard(self)
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
