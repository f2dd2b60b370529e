"""The viewer's server, which answers only its own page, and a check that the server can start."""

import contextlib
import functools
import io
import ipaddress
import socket
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from sceneprior.core.errors import InputError

if TYPE_CHECKING:
    import viser
    from websockets import Headers


def check_can_serve(host: str, port: int) -> None:
    """Check, before anything is loaded, that the server can start."""
    try:
        import viser  # noqa: F401
    except ImportError:
        raise InputError(
            "`sceneprior view` needs viser, which is not installed; pip install 'sceneprior[view]'."
        ) from None
    # viser itself would silently take the next port, which the user would not open.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(
                f"Port {port} of {host} cannot be used ({reason}); name another one: "
                f"--port {port + 1 if port < 65535 else 8080}."
            ) from None


@contextlib.contextmanager
def serving(host: str, port: int) -> Iterator["viser.ViserServer"]:
    """Run a server with an empty page; port 0 takes any free port.

    Other web sites open in the same browser can neither read the page nor use its controls.
    """
    import viser

    quiet = contextlib.redirect_stdout(io.StringIO())
    with quiet, _checking_requests(host) as checked:
        server = viser.ViserServer(host, port, verbose=False)
    try:
        if not checked:
            raise InputError(
                f"viser {viser.__version__} starts its server in a way that this release does not "
                "know, and other web sites could use the page; pip install 'viser==1.1.*'."
            )
        yield server
    finally:
        with quiet:
            server.stop()


def refusal(headers: "Headers", host: str) -> tuple[int, str] | None:
    """HTTP status and reason to refuse a request to a page bound to `host`, else None.

    Requests from the page itself, or from programs other than browsers, are accepted. The check
    uses two headers that a browser sets and no site can change. `Host` is the browser's name for
    this machine: after DNS rebinding it is still the attacking site's name. `Origin` is the
    requesting site, which for the page equals `Host`. Any port is accepted, since a tunnel
    (`ssh -L 9000:localhost:8080`) changes it.
    """
    hosts = headers.get_all("Host")
    try:
        names = [urlsplit(f"//{name}").hostname or "" for name in hosts]
        origins = [urlsplit(origin) for origin in headers.get_all("Origin")]
    except ValueError as error:
        return 400, f"The request's header Host or Origin names no place ({error}).\n"
    if len(names) != 1 or not is_own_name(names[0], host):
        return 403, (
            f"This page is not served under the name '{', '.join(hosts)}'. Open it at localhost or "
            "at an address of this machine, or start it with that name: sceneprior view --host "
            "NAME.\n"
        )
    if any(each.scheme not in ("http", "https") or each.netloc != hosts[0] for each in origins):
        return 403, "This page does not answer other web sites.\n"
    return None


def is_own_name(name: str, host: str) -> bool:
    """True if `name` is an accepted name of this machine for a page bound to `host`.

    These are localhost and `host`. Unless `host` is a loopback address, they include the machine's
    names and all IP addresses, which DNS rebinding cannot fake.

    >>> is_own_name("localhost", "127.0.0.1"), is_own_name("site.example", "127.0.0.1")
    (True, False)
    >>> is_own_name("192.0.2.7", "127.0.0.1"), is_own_name("192.0.2.7", "0.0.0.0")
    (False, True)
    """
    if name == host.lower() or _is_loopback(name):
        return True
    return not _is_loopback(host) and (_address(name) is not None or name in _machine_names())


@functools.cache
def _machine_names() -> frozenset[str]:
    name = socket.gethostname().lower()
    return frozenset({name, f"{name}.local", socket.getfqdn().lower()})


def _is_loopback(host: str) -> bool:
    address = _address(host)
    return host == "localhost" if address is None else address.is_loopback


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host)
    return None


@contextlib.contextmanager
def _checking_requests(host: str) -> Iterator[list[bool]]:
    """Patch `websockets` so that servers started inside check each request by `refusal`.

    The yielded list is non-empty once such a server has started. viser has no option for this.
    """
    from websockets.asyncio import server

    serve, checked = server.serve, []

    def serve_checked(*args: Any, process_request: Any, **options: Any) -> Any:
        def check(connection: server.ServerConnection, request: Any) -> Any:
            if (refused := refusal(request.headers, host)) is not None:
                return connection.respond(*refused)
            return process_request(connection, request)

        checked.append(True)
        return serve(*args, process_request=check, **options)

    server.serve = serve_checked  # type: ignore[assignment, misc]
    try:
        yield checked
    finally:
        server.serve = serve  # type: ignore[misc]
