import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from conflow.tracking import ui
from tests.conftest import Command

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture(scope="module")
def address(conflow: Command, workplace: Path) -> Iterator[str]:
    """The address that `make ui` prints, once it answers, over a store with one finished run."""
    assert conflow("train", "preset=smoke", "ablation=gp", "seed=9").returncode == 0
    environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    command = [sys.executable, "-m", "conflow", "ui", f"port={free_port()}"]
    with (workplace / "ui.log").open("w") as log:
        server = subprocess.Popen(
            command, cwd=workplace, env=environment, text=True, stdout=subprocess.PIPE, stderr=log
        )
    assert server.stdout is not None
    page = server.stdout.readline().strip()
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline:
        try:
            urllib.request.urlopen(page.split("#")[0]).close()
            break
        except (urllib.error.URLError, ConnectionError):
            time.sleep(0.3)
    yield page
    server.terminate()
    server.wait(timeout=30)


def test_the_pages_are_served_on_this_machine_alone(address: str) -> None:
    assert address.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(address.split("#")[0]) as answer:
        assert answer.status == 200
        assert b"MLflow" in answer.read()


def test_a_password_of_the_server_is_not_printed(
    address: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    server = address.split("/#")[0]
    monkeypatch.setenv("MLFLOW_TRACKING_URI", server.replace("//", "//ada:swordfish@"))
    ui.serve(5000)
    assert capsys.readouterr().out.strip() == address


def test_a_password_of_the_store_is_no_argument_of_the_server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Which everybody on the machine could read for as long as it runs."""
    started: list[Any] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "execve", lambda *of_it: started.extend(of_it))
    ui.serve(free_port())
    _, arguments, environment = started
    assert "mlflow.db" not in " ".join(arguments)
    assert environment["MLFLOW_BACKEND_STORE_URI"].endswith("mlflow.db")


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_a_browser_opens_on_the_charts_of_the_runs(address: str, tmp_path: Path) -> None:
    assert CHROMIUM is not None
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
    flags += ["--disable-component-update", "--disable-sync", f"--user-data-dir={tmp_path}", "--window-size=1500,1100"]
    command = [CHROMIUM, *flags, "--virtual-time-budget=30000", "--dump-dom", address]
    page = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    assert "gp-s9" in page
    assert "test/none" in page  # the heading of a group of charts


def test_a_port_that_is_taken_is_named_with_another(conflow: Command) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = int(taken.getsockname()[1])
        result = conflow("ui", f"port={port}")
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert f"port={port}: Address already in use, expected a free port; try port={port + 1}" in result.stderr


@pytest.mark.parametrize("argument", ["port=0", "port=70000", "port=http", "prot=5000", "5000"])
def test_a_bad_port_is_refused(conflow: Command, argument: str) -> None:
    result = conflow("ui", argument)
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
