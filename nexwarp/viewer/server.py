"""The web server: viser on exactly one address, behind the rules of security.py."""

import contextlib
import errno
import importlib.util
import io
import logging
import socket
import warnings
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import viser

    from nexwarp.viewer.security import Gate


class Server(NamedTuple):
    """A running server: viser's, the address to open, with the token if it needs one, and what admits connections."""

    viser: "viser.ViserServer"
    url: str
    gate: "Gate"


def start_server(host: str, port: int) -> Server:
    """Start viser on exactly this address; it refuses all requests until `gate.is_open` is set.

    ValueError: viser is not installed, or the address cannot be used; the message gives the reason.
    """
    address = check_server(host, port)
    import viser

    from nexwarp.viewer.security import Access, Gate, accept_only_known

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
    accept_only_known(server)
    return Server(server, _url(address, server.get_port(), gate.access.token), gate)


def check_server(host: str, port: int) -> str:
    """Return the numeric address of a host, an IPv4 one if it has several; viser would resolve it again.

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
    except (OSError, UnicodeError) as error:  # UnicodeError: a name that DNS cannot hold
        number = getattr(error, "errno", None)
        if number == errno.EADDRINUSE:
            raise _in_use(host, port) from None
        if number in (errno.EACCES, errno.EPERM):
            raise ValueError(f"--port: expected a port that may be used, but {port} is refused ({error})") from None
        raise ValueError(f"--host: expected an address of this machine, got {host!r} ({error})") from None


def _in_use(host: str, port: int) -> ValueError:
    return ValueError(f"--port: expected a free port, but {port} is in use on {host}; give another --port")


def _url(address: str, port: int, token: str) -> str:
    """Address to open; of all interfaces, the loopback one."""
    name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(address, address)
    return f"http://{f'[{name}]' if ':' in name else name}:{port}" + (f"/?token={token}" if token else "")
