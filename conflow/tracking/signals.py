"""Signals that ask a command to end, as an exception: never within a block that must be whole, and never lost."""

import math
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
REPEATED = 1.0
"""Seconds in which another signal is the same request: `timeout` and make both send it on."""


class Interrupted(BaseException):
    """A signal asked this process to end. Not an Exception, so that nothing takes it for an error to handle."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.exit_code = 128 + signum


@dataclass
class _State:
    """What has arrived in this process.

    Attributes:
        arrived: the signals, the first one first.
        raised: when one was raised last.
        holding: how many blocks hold them, one within the other.
    """

    arrived: list[int] = field(default_factory=list)
    raised: float = -math.inf
    holding: int = 0

    def interrupt(self, signum: int, _: FrameType | None) -> None:
        """Take a signal; raise it unless it is held or repeats the one before."""
        self.arrived.append(signum)
        if not self.holding and time.monotonic() - self.raised >= REPEATED:
            self.rise()

    def rise(self) -> None:
        """Raise the first one."""
        self.raised = time.monotonic()
        raise Interrupted(self.arrived[0])


_state = _State()


def raise_on_signals() -> None:
    """From here on, Ctrl-C, SIGTERM and SIGHUP raise `Interrupted` in the main thread, but what nohup ignores."""
    forget()
    for signum in SIGNALS:
        if signal.getsignal(signum) is not signal.SIG_IGN:
            signal.signal(signum, _state.interrupt)
    sys.unraisablehook = _unraisable


def forget() -> None:
    """Begin anew: what has arrived was not meant for what comes."""
    _state.arrived.clear()
    _state.raised, _state.holding = -math.inf, 0


def _unraisable(dropped: "sys.UnraisableHookArgs") -> None:
    if not isinstance(dropped.exc_value, Interrupted):  # which `check` raises again
        sys.__unraisablehook__(dropped)


def ending() -> None:
    """From here on signals interrupt nothing: the process ends, and says why."""
    _state.holding += 1


def arrived() -> Interrupted | None:
    """What asked this process to end, if anything did, whatever became of the exception since.

    Python drops what is raised in a destructor or in a weak reference's callback, and C code that calls back may make
    another error of it.
    """
    return Interrupted(_state.arrived[0]) if _state.arrived else None


def check() -> None:
    """Raise again what was dropped. Long work calls this now and then."""
    if _state.arrived:
        _state.rise()


@contextmanager
def held() -> Iterator[None]:
    """Signals that arrive within the block act where it ends."""
    before = len(_state.arrived)
    _state.holding += 1
    try:
        yield
    finally:
        _state.holding -= 1
        if len(_state.arrived) > before and not _state.holding:
            _state.rise()
