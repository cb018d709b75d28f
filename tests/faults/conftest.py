"""The command line in this process, a folder with a finished run, and what a refusal looks like."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from conflow import __main__ as command_line
from conflow.tracking import signals, store
from conflow.training import config
from conflow.training.datamodule import DemonstrationData
from conflow.training.model_file import MODEL_FILE
from tests.papers import model_of

RUN = "cgp-s0"


class Outcome(NamedTuple):
    """What a command left: its exit code, output and error."""

    code: int
    out: str
    err: str


Run = Callable[..., Outcome]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """`python -m conflow ...` in this process and the current folder; what it raises is raised."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.setattr(signals, "raise_on_signals", lambda: None)  # the tests' own process keeps its handlers

    def never(*_: object) -> None:
        raise AssertionError("expected a refusal, found that the tests would be replaced by a server")

    monkeypatch.setattr(os, "execve", never)

    def run(*arguments: str) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["conflow", *arguments])
        capfd.readouterr()
        code = 0
        try:
            command_line.main()
        except SystemExit as stopped:
            code = int(stopped.code or 0)
        return Outcome(code, *capfd.readouterr())

    return run


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a store of one finished run, whose network is untrained. Nobody writes to it."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        finished_run(RUN, folder)
    return folder


def finished_run(name: str, folder: Path) -> str:
    """Make a finished run of preset smoke in the current folder's store, by way of a file in `folder`; its id."""
    settings = config.load(["preset=smoke"])
    data = DemonstrationData(settings)
    torch.manual_seed(0)
    model = model_of(settings, data.T, data.D)
    checkpoint = {"state_dict": model.state_dict()}
    model.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, folder / MODEL_FILE)
    client = store.client()
    experiment = client.get_experiment_by_name(store.EXPERIMENT)
    assert experiment is not None
    tags = {"ablation": "cgp", "preset": "smoke", "seed": "0", "config_sha": settings.sha(), "data_digest": data.digest}
    run_id = str(client.create_run(experiment.experiment_id, run_name=name, tags=tags).info.run_id)
    client.log_artifact(run_id, str(folder / MODEL_FILE))
    client.set_terminated(run_id)
    return run_id


def listing(folder: Path) -> dict[str, int]:
    """Everything under a folder, with sizes; of a store so many bytes that a run more would show."""
    return {str(path.relative_to(folder)): path.lstat().st_size if path.is_file() else -1 for path in folder.rglob("*")}


def assert_refused(outcome: Outcome, *said: str) -> None:
    """Exit code 2, and one line on stderr that says all this."""
    assert outcome.code == 2, outcome
    assert outcome.err.startswith("conflow: ")
    assert len(outcome.err.splitlines()) == 1, outcome.err
    assert "Traceback" not in outcome.out + outcome.err
    assert len(outcome.err) < 700, "a bearable length"
    assert outcome.err.rstrip("\n").isprintable()
    for part in said:
        assert part in outcome.err
