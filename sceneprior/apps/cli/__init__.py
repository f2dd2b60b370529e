"""The entry point of `sceneprior`: failures and warnings in one sentence each, and Ctrl-C.

`main` imports the commands (commands.py) itself, so that Ctrl-C is handled during the import.
"""

import atexit
import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

AGAIN_S = 0.5
"""Seconds until a dropped KeyboardInterrupt is raised again."""


def main() -> None:
    """Run the command; an error in the input prints one sentence and exits with status 2."""
    # Read by libraries that are imported later. Sums over several threads round differently, so
    # results would depend on the machine; `fit` gives torch the number of threads in its config.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ[f"{library}_NUM_THREADS"] = "1"
    with answering_ctrl_c() as was_pressed:
        try:
            _prepare_environment()
            from sceneprior.apps.cli.commands import app

            with warnings_as_sentences():
                app()
        except SystemExit as ended:
            # After Ctrl-C, Typer exits with status 130 and prints nothing.
            if ended.__context__ and isinstance(ended.__context__.__cause__, KeyboardInterrupt):
                _stopped()
            raise
        except KeyboardInterrupt:
            _stopped()
        except Exception as error:
            if was_pressed():
                _stopped()  # some libraries turn the KeyboardInterrupt into another error
            _failed(error)


def _prepare_environment() -> None:
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal may not know a letter of a path
        sys.stdout.reconfigure(errors="backslashreplace")
    threads = os.environ.get("NUMBA_NUM_THREADS") or "1"
    if not threads.isdecimal() or int(threads) == 0:  # numba's own error does not name it
        from sceneprior.core.errors import InputError

        raise InputError(f"NUMBA_NUM_THREADS is '{threads}', expected 1 or more; unset it.")


def _stopped() -> NoReturn:
    print("Stopped by Ctrl-C. No file is left half-written.", file=sys.stderr)
    sys.exit(130)


def _failed(error: Exception) -> NoReturn:
    from sceneprior.core.errors import sentence_of

    if (sentence := sentence_of(error)) is not None:
        print(f"Error: {sentence}", file=sys.stderr)
        sys.exit(2)
    if os.environ.get("SCENEPRIOR_DEBUG"):
        raise error
    print(
        f"Error: {type(error).__name__}: {error}\nThis should not happen. Run again with "
        "SCENEPRIOR_DEBUG=1 for the traceback, and please report it.",
        file=sys.stderr,
    )
    sys.exit(1)


@contextmanager
def warnings_as_sentences() -> Iterator[None]:
    """Print each `InputWarning` without the source line that Python adds; hide NumPy's warnings of
    numbers in damaged files, for which a sentence follows."""
    from sceneprior.core.errors import InputWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        show = warnings.showwarning

        def say(message: Warning | str, category: type[Warning], *where: Any, **to: Any) -> None:
            if issubclass(category, InputWarning):
                print(f"Warning: {message}", file=sys.stderr)
            else:
                show(message, category, *where, **to)

        warnings.showwarning = say
        yield


class CtrlC(KeyboardInterrupt):
    """Ctrl-C was pressed.

    A subclass is needed: after a plain KeyboardInterrupt has passed through `exec`, as during
    imports, CPython ends the process by a signal, whatever the requested exit status.
    """


@contextmanager
def answering_ctrl_c() -> Iterator[Callable[[], bool]]:
    """Raise a KeyboardInterrupt on Ctrl-C, and repeat it until it is handled.

    Python drops exceptions raised in callbacks of the garbage collector, and some libraries catch
    all exceptions while they import. Therefore Ctrl-C starts a timer: if no KeyboardInterrupt is
    being handled when the timer fires, the previous one was dropped, and it is raised again.

    A process that was started to ignore Ctrl-C, such as a shell's background process, keeps
    ignoring it. Ctrl-C is also ignored while the process exits.

    Yields:
        A function that returns True after Ctrl-C was pressed.
    """
    pressed = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if number == signal.SIGALRM and _is_handled(sys.exc_info()[1]):
            return
        pressed = True
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S, AGAIN_S)
        raise CtrlC

    def report(dropped: Any) -> None:
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            report_before(dropped)

    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: False
        return
    report_before, sys.unraisablehook = sys.unraisablehook, report
    alarm_before = signal.signal(signal.SIGALRM, interrupt)
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield lambda: pressed
    finally:
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, alarm_before)
        sys.unraisablehook = report_before


def _is_handled(error: BaseException | None) -> bool:
    """True if an exception is a KeyboardInterrupt, or was raised while handling one."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None
