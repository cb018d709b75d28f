"""Signals that ask a command to end, as an exception."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(BaseException):
    """A signal asked this process to end. Not an Exception, so that nothing takes it for an error to handle."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.exit_code = 128 + signum


RAISED: list[int] = []
"""The signals that were raised so far."""


def raise_on_signals() -> None:
    """From here on, Ctrl-C, SIGTERM and SIGHUP raise `Interrupted` in the main thread."""
    RAISED.clear()

    def interrupt(signum: int, _: FrameType | None) -> None:
        RAISED.append(signum)
        raise Interrupted(signum)

    def unraisable(dropped: "sys.UnraisableHookArgs") -> None:
        if not isinstance(dropped.exc_value, Interrupted):  # which `check` raises again
            sys.__unraisablehook__(dropped)

    for signum in SIGNALS:
        signal.signal(signum, interrupt)
    sys.unraisablehook = unraisable


def arrived() -> Interrupted | None:
    """What asked this process to end, if anything did, whatever became of the exception since.

    Python drops what is raised in a destructor or in a weak reference's callback, and C code that calls back may make
    another error of it.
    """
    return Interrupted(RAISED[0]) if RAISED else None


def check() -> None:
    """Raise again what was dropped. Long work calls this now and then."""
    if interrupted := arrived():
        raise interrupted


@contextmanager
def held() -> Iterator[None]:
    """Signals that arrive within the block act where it ends."""
    arrived: list[int] = []

    def keep(signum: int, _: FrameType | None) -> None:
        arrived.append(signum)

    handlers = {signum: signal.signal(signum, keep) for signum in SIGNALS}
    try:
        yield
    finally:
        for signum, handler in handlers.items():
            signal.signal(signum, handler)
        if arrived:
            signal.raise_signal(arrived[0])
