import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from conflow import __main__ as command_line
from conflow.tracking import signals
from conflow.training import config
from conflow.training.config import Config

Command = Callable[..., subprocess.CompletedProcess[str]]
Typed = Callable[..., tuple[int, str, str]]

# A shell begins what it puts into the background deaf to Ctrl-C, and processes inherit that; tests are about those that
# hear it.
for deaf in signals.SIGNALS:
    if signal.getsignal(deaf) is signal.SIG_IGN:
        signal.signal(deaf, signal.default_int_handler if deaf == signal.SIGINT else signal.SIG_DFL)


@pytest.fixture(scope="session")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose runs/ the commands of all tests share: a new store takes seconds to make."""
    return tmp_path_factory.mktemp("workplace")


@pytest.fixture(scope="session")
def conflow(workplace: Path) -> Command:
    """Run the command line in the workplace, as a user would."""

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
        command = [sys.executable, "-m", "conflow", *arguments]
        return subprocess.run(command, cwd=workplace, env=environment, capture_output=True, text=True, timeout=300)

    return run


@pytest.fixture
def in_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Typed:
    """Run the command line in an empty folder and in the tests' own process: exit code, output and error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(signals, "raise_on_signals", lambda: None)  # the process keeps its handlers

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["conflow", *arguments])
        code = 0
        try:
            command_line.main()
        except SystemExit as stopped:
            code = int(stopped.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return run


@pytest.fixture(scope="session")
def smoke() -> Config:
    """The smallest experiment."""
    return config.load(["preset=smoke"])


@contextmanager
def raising_signals() -> Iterator[None]:
    """Signals act in the block as in a command."""
    signals.forget()
    handlers = {signum: signal.getsignal(signum) for signum in signals.SIGNALS}
    unraisable = sys.unraisablehook
    signals.raise_on_signals()
    try:
        yield
    finally:
        signals.forget()
        sys.unraisablehook = unraisable
        for signum, handler in handlers.items():
            signal.signal(signum, handler)
