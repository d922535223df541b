"""Who may open the viewer: rules on the Host, the Origin and the token of a request.

* The Origin, which browsers send with every WebSocket, must be the server's own: "http://" and the Host. Programs that
  are not browsers send none; no page of another server can make them connect.
* On a loopback address the Host must be "localhost" or a loopback address. A name that somebody lets lead to 127.0.0.1
  (DNS rebinding) is its own Host and Origin, and is refused by this rule.
* On any other address each request needs the token: in the URL, or in the cookie that the page's response sets.
"""

import hmac
import ipaddress
import secrets
from dataclasses import dataclass
from typing import Protocol
from urllib.parse import parse_qs, urlsplit

TOKEN_BYTES = 24  # 192 bits


class Headers(Protocol):
    """Headers of a request; names are case-insensitive."""

    def get_all(self, key: str) -> list[str]:
        """All values of a header, in order."""


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
    """The rules of one server.

    Attributes:
        local: the server listens on a loopback address.
        token: what each request must hold; "" on a loopback address, where it needs none.
    """

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
        cookies = (pair.strip().partition("=") for line in headers.get_all("Cookie") for pair in line.split(";"))
        tokens = [_query_token(target), *(value for name, _, value in cookies if name == _cookie_name(host[1]))]
        if self.token and not any(self._is_token(token) for token in tokens):
            return "the viewer needs its token: open the address with ?token=, as nexwarp has printed it"
        return None

    def cookie(self, target: str, headers: Headers) -> str | None:
        """Return the cookie for the response to an admitted page request with the token in its URL; else None."""
        host = authority(headers.get_all("Host")[0])
        if not self.token or host is None or not self._is_token(_query_token(target)):
            return None
        return f"{_cookie_name(host[1])}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _is_token(self, text: str) -> bool:
        """Compare in constant time."""
        return hmac.compare_digest(text.encode("utf-8", "surrogateescape"), self.token.encode())


def _cookie_name(port: int) -> str:
    """Cookies of a host are shared by its ports; each viewer has one of its own."""
    return f"nexwarp_{port}"


def _query_token(target: str) -> str:
    return parse_qs(target.partition("?")[2]).get("token", [""])[0]
