"""The page answers its own requests alone: no other site that a browser has open can use it."""

import socket
from types import SimpleNamespace

import pytest

from sceneprior.core.errors import InputError

viser = pytest.importorskip("viser", reason="the extra `view` is not installed")

from sceneprior.apps.viewer.server import is_own_name, serving  # noqa: E402

SOCKET = (
    ("Upgrade", "websocket"),
    ("Connection", "Upgrade"),
    ("Sec-WebSocket-Key", "dGhlIHNhbXBsZSBub25jZQ=="),
    ("Sec-WebSocket-Version", "13"),
    ("Sec-WebSocket-Protocol", f"viser-v{viser.__version__}"),
)


@pytest.fixture(scope="module")
def port():
    with serving("127.0.0.1", 0) as server:
        yield server.get_port()


def status_of(port: int, *headers: tuple[str, str]) -> int:
    """The status of the answer to a request with just these headers."""
    lines = ["GET / HTTP/1.1", *(f"{name}: {value}" for name, value in headers), "", ""]
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        connection.sendall("\r\n".join(lines).encode())
        return int(connection.makefile("rb").readline().split()[1])


@pytest.mark.parametrize(("more", "answered"), [((), 200), (SOCKET, 101)], ids=["page", "socket"])
def test_its_own_page_is_answered_and_other_sites_are_not(port, more, answered):
    own = f"localhost:{port}"
    for host in (own, f"127.0.0.1:{port}", f"LOCALHOST:{port}", f"[::1]:{port}", "localhost:9000"):
        assert status_of(port, ("Host", host), *more) == answered, host
        origin = ("Origin", f"http://{host.lower()}")
        assert status_of(port, ("Host", host.lower()), origin, *more) == answered, host
    for origin in ("http://site.example", "http://localhost:1", f"http://127.0.0.1:{port}", "null"):
        assert status_of(port, ("Host", own), ("Origin", origin), *more) == 403, origin
    for host in (f"site.example:{port}", f"localhost.site.example:{port}", f"192.0.2.7:{port}", ""):
        assert status_of(port, ("Host", host), *more) == 403, host
        assert status_of(port, ("Host", host), ("Origin", f"http://{host}"), *more) == 403, host
    for origin in (f"file://{own}", f"ftp://{own}", "file:///page.html", own, ""):
        assert status_of(port, ("Host", own), ("Origin", origin), *more) == 403, origin
    for broken in ("[::1", "[", "[x]", f"[{own}", "]"):
        assert status_of(port, ("Host", broken), *more) in (400, 403), broken
        origin = ("Origin", f"http://{broken}")
        assert status_of(port, ("Host", own), origin, *more) in (400, 403), broken
    assert status_of(port, *more) == 403  # no host
    assert status_of(port, ("Host", own), ("Host", "site.example"), *more) == 403


def test_a_page_for_others_answers_to_the_names_of_this_machine():
    for host in ("0.0.0.0", "192.0.2.7", "machine.example"):
        assert is_own_name("localhost", host) and is_own_name("192.0.2.7", host)
        assert is_own_name(socket.gethostname().lower(), host)
        assert not is_own_name("site.example", host)
    assert is_own_name("machine.example", "Machine.Example")


def test_a_viser_that_cannot_be_kept_from_other_sites_is_refused(monkeypatch):
    closed = []
    other = SimpleNamespace(stop=lambda: closed.append(True))
    monkeypatch.setattr(viser, "ViserServer", lambda *_, **__: other)
    refused = pytest.raises(InputError, match="other web sites could use the page; pip install")
    with refused, serving("127.0.0.1", 0):
        pass
    assert closed
