"""Signals that ask a command to end, as an exception."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(BaseException):
    """A signal asked this process to end. Not an Exception, so that nothing takes it for an error to handle."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.exit_code = 128 + signum


def raise_on_signals() -> None:
    """From here on, Ctrl-C, SIGTERM and SIGHUP raise `Interrupted` in the main thread."""

    def interrupt(signum: int, _: FrameType | None) -> None:
        raise Interrupted(signum)

    for signum in SIGNALS:
        signal.signal(signum, interrupt)


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
