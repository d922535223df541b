"""The web server: viser on exactly one address, which accepts only its own pages and the messages of the viewer."""

import contextlib
import errno
import importlib.util
import io
import logging
import socket
import warnings
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    import viser
    import viser.infra

LOOPBACK = {"127.0.0.1", "::1", "localhost"}
# Messages of the panels and the canvas. viser's client knows others, such as uploads and public tunnels.
ACCEPTED = {"ViewerCameraMessage", "GuiUpdateMessage", "SceneNodeClickMessage"}
log = logging.getLogger(__name__)


def start_server(host: str, port: int) -> "viser.ViserServer":
    """Start viser on exactly this address.

    Args:
        host: name or address of an interface of this machine. On a loopback address only pages of this server may
            connect, since any page that is open in a browser can reach it.
        port: 1 to 65535, or 0 for any free port.

    Raises:
        ValueError: viser is not installed, or the address cannot be used; the message gives the reason.
    """
    check_server(host, port)
    import viser

    # Broken connections and invalid messages are errors of the page: they are not logged.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", ".* on a closed connection", UserWarning)  # a tab was closed
    with contextlib.redirect_stdout(io.StringIO()):  # drops its banner
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if port and server.get_port() != port:  # the port was taken after the check; viser chose the next one
        server.stop()
        raise _in_use(host, port)
    _guard(server, host)
    return server


def check_server(host: str, port: int) -> None:
    """Raise ValueError if viser is missing or the address cannot be used; viser itself would try other ports."""
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
    """Whether a page may connect to the server.

    Args:
        host: address that the server listens on; any page may connect unless it is a loopback address.
        origin: origin of the page, such as "http://127.0.0.1:8080"; None for programs other than browsers.
        asked: host and port that the page connects to, such as "127.0.0.1:8080".
    """
    if host not in LOOPBACK or origin is None:
        return True
    parts = urlsplit(origin)
    return parts.hostname in LOOPBACK and parts.netloc == asked


def _guard(server: "viser.ViserServer", host: str) -> None:
    """Refuse pages of other servers, drop messages that the viewer does not use, and ignore invalid ones."""
    websockets = server._websock_server
    server.get_event_loop().set_exception_handler(lambda _loop, context: log.debug("dropped: %s", context))
    _accept_only(websockets)

    async def admit(connection: "viser.infra.WebsockClientConnection") -> None:
        _accept_only(connection)
        socket = websockets._live_connections[connection.client_id]
        assert socket.request is not None  # set by the handshake
        headers = socket.request.headers
        if not may_connect(host, headers.get("Origin"), headers.get("Host")):
            await socket.close(1008, "the page is from another server")

    websockets.on_client_connect(admit)


def _accept_only(handler: "viser.infra.WebsockMessageHandler") -> None:
    """Make a viser message handler ignore all messages but `ACCEPTED`, and updates of properties but the value."""
    handle = handler._handle_incoming_message

    async def accept(client_id: "viser.infra.ClientId", message: "viser.infra.Message") -> None:
        name = type(message).__name__
        if name in ACCEPTED and (name != "GuiUpdateMessage" or set(getattr(message, "updates", ())) == {"value"}):
            await handle(client_id, message)

    # viser has no public way to filter messages.
    handler._handle_incoming_message = accept  # type: ignore[method-assign]
