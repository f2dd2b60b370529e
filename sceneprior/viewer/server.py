"""The server of the page: whether there can be one, and one that starts and stops quietly."""

import contextlib
import io
import socket
from collections.abc import Iterator
from typing import TYPE_CHECKING

from sceneprior.errors import InputError

if TYPE_CHECKING:
    import viser


def check_can_serve(host: str, port: int) -> None:
    """Refuse before anything is loaded what would fail afterwards.

    Raises:
        InputError: the extra `view` is not installed, or the port is taken.
    """
    try:
        import viser  # noqa: F401
    except ImportError:
        raise InputError(
            "`sceneprior view` needs viser, which is not installed; pip install 'sceneprior[view]'."
        ) from None
    # viser itself would quietly take the next port, and nobody would look there.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(
                f"Port {port} of {host} cannot be had ({reason}); name another one: "
                f"--port {port + 1 if port < 65535 else 8080}."
            ) from None


@contextlib.contextmanager
def serving(host: str, port: int) -> Iterator["viser.ViserServer"]:
    """An empty page; port 0 takes any that is free."""
    import viser

    with _quiet():  # it greets with a panel of its own
        server = viser.ViserServer(host, port, verbose=False)
    try:
        yield server
    finally:
        with _quiet():
            server.stop()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    with contextlib.redirect_stdout(io.StringIO()):
        yield
