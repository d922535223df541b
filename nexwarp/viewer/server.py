"""The web server: viser, on one address and no other, for pages of its own and messages that it asked for."""

import contextlib
import errno
import importlib.util
import io
import logging
import socket
import warnings
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    import viser

LOOPBACK = {"127.0.0.1", "::1", "localhost"}
# Everything that the panels and the canvas send; viser's client can send more (uploads, public tunnels).
ACCEPTED = {"ViewerCameraMessage", "GuiUpdateMessage", "SceneNodeClickMessage"}
log = logging.getLogger(__name__)


def start_server(host: str, port: int) -> "viser.ViserServer":
    """Start viser on exactly this address.

    Args:
        host: name or address of an interface of this machine. On a loopback one, only pages that this server sent
            itself may connect: any other page that is open in a browser could reach it too.
        port: 1 to 65535, or 0 for any that is free.

    Raises:
        ValueError: viser is not installed, or nothing can listen there, with the reason.
    """
    check_server(host, port)
    import viser

    # A page that breaks off or sends rubbish is its own affair: no traceback.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", ".* on a closed connection", UserWarning)  # a tab may close at any time
    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if port and server.get_port() != port:  # taken since the check; viser moves on to the next
        server.stop()
        raise _in_use(host, port)
    _guard(server, host)
    return server


def check_server(host: str, port: int) -> None:
    """Raise ValueError unless `start_server` can be expected to succeed; viser would try other ports, and for ever."""
    if importlib.util.find_spec("viser") is None:
        raise ValueError("the viewer needs the package viser, found none; pip install 'nexwarp[viewer]'")
    if not 0 <= port <= 65535:
        raise ValueError(f"--port: expected 0 to 65535, got {port}")
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, kind, protocol, _, address in addresses:
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
                probe.listen()
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _in_use(host, port) from None
        if error.errno in (errno.EACCES, errno.EPERM):
            raise ValueError(f"--port: expected a port that may be used, but {port} is refused ({error})") from None
        raise ValueError(f"--host: expected an address of this machine, got {host!r} ({error})") from None


def _in_use(host: str, port: int) -> ValueError:
    return ValueError(f"--port: expected a free port, but {port} is in use on {host}; give another --port")


def may_connect(host: str, origin: str | None, asked: str | None) -> bool:
    """Whether a page may talk to a server that listens on `host`.

    Args:
        host: what the server listens on; anybody may connect unless it is loopback.
        origin: of the page, such as "http://127.0.0.1:8080"; programs that are no browser send none.
        asked: the address that it connects to, "127.0.0.1:8080".
    """
    if host not in LOOPBACK or origin is None:
        return True
    parts = urlsplit(origin)
    return parts.hostname in LOOPBACK and parts.netloc == asked


def _guard(server: "viser.ViserServer", host: str) -> None:
    """Refuse foreign pages, drop every message that no part of the viewer sends, and survive broken ones."""
    websockets = server._websock_server
    server.get_event_loop().set_exception_handler(lambda _loop, context: log.debug("dropped: %s", context))
    _accept_only(websockets)

    async def admit(connection: Any) -> None:
        _accept_only(connection)
        socket = websockets._live_connections[connection.client_id]
        headers = socket.request.headers
        if not may_connect(host, headers.get("Origin"), headers.get("Host")):
            await socket.close(1008, "the page is from another server")

    websockets.on_client_connect(admit)


def _accept_only(handler: Any) -> None:
    """Make a viser message handler ignore all but `ACCEPTED`; of updates, all that is no value."""
    handle = handler._handle_incoming_message

    async def accept(client_id: Any, message: Any) -> None:
        name = type(message).__name__
        if name in ACCEPTED and (name != "GuiUpdateMessage" or set(message.updates) == {"value"}):
            await handle(client_id, message)

    handler._handle_incoming_message = accept
