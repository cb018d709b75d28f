"""Signals that ask a command to end, as an exception."""

import signal
from types import FrameType


class Interrupted(BaseException):
    """A signal asked this process to end. Not an Exception, so that nothing takes it for an error to handle."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.exit_code = 128 + signum


def raise_on_signals() -> None:
    """From here on, Ctrl-C, SIGTERM and SIGHUP raise `Interrupted` in the main thread."""

    def interrupt(signum: int, _: FrameType | None) -> None:
        raise Interrupted(signum)

    for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(signum, interrupt)
