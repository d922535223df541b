import http.client
from urllib.parse import urlsplit

import pytest
from websockets.datastructures import Headers

from nexwarp.viewer import Viewer, listen
from nexwarp.viewer.security import Access, is_loopback
from tests.viewer.support import Client, serving

LOCAL, OPEN = Access(), Access(token="secret")


def headers(host: str, origin: str | None = None, **others: str) -> Headers:
    return Headers({"Host": host} | ({} if origin is None else {"Origin": origin}) | others)


@pytest.mark.parametrize("address", ["127.0.0.1", "127.0.0.2", "127.255.255.254", "::1", "::ffff:127.0.0.1"])
@pytest.mark.parametrize("other", ["0.0.0.0", "::", "10.0.0.7", "::ffff:10.0.0.7", "fe80::1%eth0", "localhost", ""])
def test_other_addresses_than_loopback_need_a_token_of_at_least_128_bits(address, other):
    assert is_loopback(address) and Access.to(address) == LOCAL
    token = Access.to(other).token
    assert not is_loopback(other) and token != Access.to(other).token and len(token) >= 128 / 6, "6 bits a character"


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:9000", "LocalHost", "127.0.0.2:8080", "[::1]:8080"])
def test_own_pages_and_programs_may_connect(host):
    assert LOCAL.refusal("/", headers(host)) is None, "no browser, or the page itself"
    assert LOCAL.refusal("/", headers(host, f"http://{host}".lower())) is None


@pytest.mark.parametrize(
    "host, origin",
    [
        ("127.0.0.1:8080", "http://evil.example"),
        ("127.0.0.1:8080", "https://127.0.0.1:8080"),
        ("127.0.0.1:8080", "http://127.0.0.1:3000"),
        ("127.0.0.1:8080", "http://localhost:8080"),
        ("127.0.0.1:8080", "http://127.0.0.1:8080@evil.example"),
        ("127.0.0.1:8080", "null"),
    ],
)
def test_pages_of_other_origins_may_not(host, origin):
    assert "page of another server" in str(LOCAL.refusal("/", headers(host, origin)))
    token = "/?token=secret"
    assert OPEN.refusal(token, headers(host)) is None
    assert "page of another server" in str(OPEN.refusal(token, headers(host, origin)))


@pytest.mark.parametrize(
    "host", ["evil.example:8080", "127.0.0.1.evil.example", "0.0.0.0:8080", "10.0.0.7", "[::]:8080"]
)
def test_a_name_that_leads_here_is_refused_on_a_loopback_address(host):
    """DNS rebinding: the page's Origin is its Host."""
    for origin in (None, f"http://{host}"):
        assert "this machine only" in str(LOCAL.refusal("/", headers(host, origin)))


@pytest.mark.parametrize("hosts", [[], ["127.0.0.1", "127.0.0.1"], [""], ["a b/"], ["user@127.0.0.1"], ["127.0.0.1:x"]])
def test_one_valid_host_is_needed(hosts):
    assert "one header Host" in str(LOCAL.refusal("/", Headers([("Host", host) for host in hosts])))


def test_the_token_is_in_the_url_or_the_cookie():
    own = headers("lab.example:8080", "http://lab.example:8080")
    assert OPEN.refusal("/?token=secret", own) is None
    for target in ("/", "/?token=secre", "/?token=secret2", "/?token=%FF", "/?token=a&token=secret"):
        assert "needs its token" in str(OPEN.refusal(target, own)) and OPEN.cookie(target, own) is None
    cookie = OPEN.cookie("/?token=secret", own)
    assert cookie == "nexwarp_8080=secret; Path=/; HttpOnly; SameSite=Strict"
    assert OPEN.refusal("/", headers("lab.example:8080", Cookie=f"other=1; {cookie.split(';')[0]}")) is None
    for wrong in ("nexwarp_8080=wrong", "nexwarp_8081=secret", "nexwarp_8080", ""):
        assert "needs its token" in str(OPEN.refusal("/", headers("lab.example:8080", Cookie=wrong)))
    assert LOCAL.cookie("/?token=", headers("localhost")) is None


def get(viewer: Viewer, path: str, **send: str) -> tuple[int, http.client.HTTPMessage, str]:
    """Status, headers and text of a page."""
    url = urlsplit(viewer.url)
    connection = http.client.HTTPConnection(str(url.hostname), url.port, timeout=20)
    try:
        connection.request("GET", path, headers=send)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read().decode()
    finally:
        connection.close()


def refusal(viewer: Viewer, **arguments: object) -> str:
    """The text with which a WebSocket is refused with 403."""
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus) as caught:
        Client(viewer, **arguments)
    assert caught.value.response.status_code == 403
    return caught.value.response.body.decode()


@pytest.mark.parametrize("host", ["127.0.0.1", "LOCALHOST", "0"])
def test_pages_of_other_servers_are_refused(model, host):
    with serving(model, host=host) as viewer:
        assert "page of another server" in refusal(viewer, origin="http://evil.example")
        path = urlsplit(viewer.url)._replace(scheme="", netloc="").geturl() or "/"
        status, _, text = get(viewer, path, Origin="null")
        assert status == 403 and "page of another server" in text and not viewer.sessions
        with Client(viewer, origin=viewer.url.partition("/?")[0]) as client:
            client.look()
            assert client.picture().ndim == 3
        if host != "0":
            assert "token" not in viewer.url
            assert get(viewer, "/", **{"Host": f"evil.example:{urlsplit(viewer.url).port}"})[0] == 403


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_other_addresses_are_opened_with_the_token_only(model, host):
    with serving(model, host=host) as viewer:
        token = urlsplit(viewer.url).query
        assert token.startswith("token=") and len(token) > 22
        status, _, text = get(viewer, "/?token=wrong")
        assert status == 403 and "needs its token" in text and "html" not in text
        status, sent, page = get(viewer, f"/?{token}")
        assert status == 200 and "<html" in page
        assert sent["Referrer-Policy"] == "no-referrer" and sent["Cache-Control"] == "no-store"
        cookie = sent["Set-Cookie"].split(";")[0]
        assert get(viewer, "/", Cookie=cookie)[0] == 200
        own = viewer.url.partition("/?")[0]
        viewer.url = own
        assert "needs its token" in refusal(viewer, origin=own)
        with Client(viewer, origin=own, additional_headers={"Cookie": cookie}) as client:
            client.look()
            assert client.picture().ndim == 3


def test_a_name_is_looked_up_once_and_ipv4_is_preferred():
    for name in ("localhost", "127.1"):
        with listen(name, 0) as listener:
            assert listener.getsockname()[0] == "127.0.0.1"
    with pytest.raises(ValueError, match="--host: expected an address of this machine, got 'aaa"):
        listen("a" * 70, 0)
