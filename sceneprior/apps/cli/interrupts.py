"""Reliable handling of Ctrl-C: a KeyboardInterrupt that is dropped is raised again."""

import atexit
import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

AGAIN_S = 0.5
"""Seconds until a dropped KeyboardInterrupt is raised again."""


class CtrlC(KeyboardInterrupt):
    """Ctrl-C was pressed.

    A subclass is needed: after a plain KeyboardInterrupt has passed through `exec`, as during
    imports, CPython ends the process by a signal, whatever the requested exit status.
    """


@contextlib.contextmanager
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
