"""The web server: viser on exactly one address, which accepts only its own pages and the messages of the viewer."""

import contextlib
import errno
import importlib.util
import io
import logging
import math
import socket
import warnings
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING

from nexwarp.viewer.access import Access

if TYPE_CHECKING:
    import viser
    import viser.infra

    from nexwarp.viewer.connections import Gate

# Messages of the panels and the canvas. viser's client knows others, such as uploads and public tunnels.
ACCEPTED = {"ViewerCameraMessage", "GuiUpdateMessage", "SceneNodeClickMessage"}
# Numbers that a camera message must hold, by field: None is one number, otherwise the length of a list.
CAMERA_FIELDS = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3} | dict.fromkeys(
    ("fov", "image_width", "image_height")
)
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Server:
    """A running server: viser's, the address to open, with the token if it needs one, and what admits connections."""

    viser: "viser.ViserServer"
    url: str
    gate: "Gate"

    def waiting(self, client_id: int) -> int:
        """Number of messages that a client has not taken yet; 0 for one that has left."""
        from nexwarp.viewer.connections import Connection

        server = self.viser._websock_server
        state, connection = server._client_state_from_id.get(client_id), server._live_connections.get(client_id)
        if state is None or connection is None:
            return 0
        assert isinstance(connection, Connection)
        return len(state.message_buffer.message_from_id) + connection.sending

    def stop(self) -> None:
        """Disconnect all browsers and stop."""
        with contextlib.redirect_stdout(io.StringIO()):  # drops its message
            self.viser.stop()


def start_server(host: str, port: int) -> Server:
    """Start viser on exactly this address; it refuses all requests until `gate.is_open` is set.

    Raises:
        ValueError: viser is not installed, or the address cannot be used; the message gives the reason.
    """
    address = check_server(host, port)
    import viser

    from nexwarp.viewer.connections import Gate

    # Broken connections and invalid messages are errors of the page: they are not logged.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", ".* on a closed connection", UserWarning)  # a tab was closed
    gate = Gate(Access.to(address))
    with contextlib.redirect_stdout(io.StringIO()), gate.before_viser():  # drops its banner
        server = viser.ViserServer(host=address, port=port, verbose=False)
    if not gate.attached:
        server.stop()
        raise ValueError(f"the viewer needs viser as in constraints.txt, found {viser.__version__}")
    if port and server.get_port() != port:  # the port was taken after the check; viser chose the next one
        server.stop()
        raise _in_use(host, port)
    _accept_only_known(server)
    return Server(server, _url(address, server.get_port(), gate.access.token), gate)


def check_server(host: str, port: int) -> str:
    """Return the numeric address of a host, an IPv4 one if it has several; viser would resolve it again.

    Raises:
        ValueError: viser is missing, or the address cannot be used; viser itself would try other ports.
    """
    if importlib.util.find_spec("viser") is None:
        raise ValueError("the viewer needs the package viser, found none; pip install 'nexwarp[viewer]'")
    if not 0 <= port <= 65535:
        raise ValueError(f"--port: expected 0 to 65535, got {port}")
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, kind, protocol, _, address = min(addresses, key=lambda entry: entry[0] != socket.AF_INET)
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            probe.listen()
        return socket.getnameinfo(address, socket.NI_NUMERICHOST | socket.NI_NUMERICSERV)[0]
    except UnicodeError as error:  # a name that DNS cannot hold
        raise ValueError(f"--host: expected an address of this machine, got {host!r} ({error})") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _in_use(host, port) from None
        if error.errno in (errno.EACCES, errno.EPERM):
            raise ValueError(f"--port: expected a port that may be used, but {port} is refused ({error})") from None
        raise ValueError(f"--host: expected an address of this machine, got {host!r} ({error})") from None


def _in_use(host: str, port: int) -> ValueError:
    return ValueError(f"--port: expected a free port, but {port} is in use on {host}; give another --port")


def _url(address: str, port: int, token: str) -> str:
    """Address to open; of all interfaces, the loopback one."""
    name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(address, address)
    return f"http://{f'[{name}]' if ':' in name else name}:{port}" + (f"/?token={token}" if token else "")


def _accept_only_known(server: "viser.ViserServer") -> None:
    """Drop messages that the viewer does not use, and ignore invalid ones; viser has no public way to do so."""
    server.get_event_loop().set_exception_handler(lambda _loop, context: log.debug("dropped: %s", context))

    def watch(handler: "viser.infra.WebsockMessageHandler") -> None:
        handle = handler._handle_incoming_message

        async def accept(client_id: "viser.infra.ClientId", message: "viser.infra.Message") -> None:
            if _is_valid(message):
                await handle(client_id, message)

        handler._handle_incoming_message = accept  # type: ignore[method-assign]

    watch(server._websock_server)
    server._websock_server.on_client_connect(watch)


def _is_valid(message: "viser.infra.Message") -> bool:
    """Whether a message is of a known type; updates may change the value only, cameras are finite numbers."""
    name = type(message).__name__
    if name == "GuiUpdateMessage":
        return set(getattr(message, "updates", ())) == {"value"}
    if name == "ViewerCameraMessage":
        fields = {field: getattr(message, field) for field in CAMERA_FIELDS}
        return all(_are_numbers(values, CAMERA_FIELDS[field]) for field, values in fields.items())
    return name in ACCEPTED


def _are_numbers(values: object, count: int | None) -> bool:
    """Whether these are finite numbers: one if `count` is None, otherwise a list of as many."""
    if count is None:
        return isinstance(values, Real) and math.isfinite(values)
    return isinstance(values, (list, tuple)) and len(values) == count and all(_are_numbers(x, None) for x in values)
