import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from conflow.grid import local
from conflow.grid.local import Job, _train_all
from conflow.tracking import recording, signals
from conflow.training import config, progress
from conflow.training.datamodule import DemonstrationData
from conflow.training.progress import ProgressDisplay
from conflow.training.train import experiment
from tests.conftest import raising_signals

GRID = ["ablations", "preset=smoke", "seeds=0", "ablations=cgp fm"]


def grid(folder: Path, *arguments: str) -> "subprocess.Popen[str]":
    environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    command = [sys.executable, "-m", "conflow", *GRID, *arguments]
    return subprocess.Popen(
        command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )


@pytest.mark.parametrize("argument", ["ablations=cgp cpg", "seeds=0 x", "jobs=0", "sedes=0 1"])
def test_a_grid_with_a_mistyped_cell_is_refused_before_any_is_started(argument: str, tmp_path: Path) -> None:
    refused = grid(tmp_path, argument)
    output, _ = refused.communicate(timeout=300)
    assert refused.returncode == 2
    assert len(output.splitlines()) == 1
    assert not (tmp_path / "runs" / "mlflow.db").exists()


@pytest.mark.parametrize(
    ("seeds", "arguments", "names"),
    [(["0", "0"], [], ["cgp-s0", "fm-s0"]), (["0", "1"], ["seed=5"], ["cgp-s5", "fm-s5"])],
)
def test_an_experiment_that_is_asked_for_twice_is_one_cell(
    seeds: list[str], arguments: list[str], names: list[str]
) -> None:
    found = local.cells(["cgp", "fm"], seeds, ["preset=smoke", *arguments])
    assert [cell.name for cell in found] == names


def test_what_another_process_trains_or_has_finished_meanwhile_is_not_trained_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three cells one is at work elsewhere as the grid begins, and one is finished elsewhere during the first."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    cgp, _, plus = (cell.config for cell in local.cells(["cgp", "fm", "plus"], ["0"], ["preset=smoke"]))
    popen, started = subprocess.Popen, list[str]()

    def begin(command: list[str], **options: Any) -> "subprocess.Popen[str]":
        if "train" not in command:
            return popen(command, **options)
        started.extend(argument for argument in command if argument.startswith("ablation="))
        with recording.start(experiment(plus, DemonstrationData(plus))):
            pass
        return popen([sys.executable, "-c", ""], **options)

    monkeypatch.setattr(subprocess, "Popen", begin)
    console = Console(width=200)
    with console.capture() as captured, recording.start(experiment(cgp, DemonstrationData(cgp))):
        assert local.run(["cgp", "fm", "plus"], ["0"], ["preset=smoke"], 1, console) == 0
    assert started == ["ablation=fm"]
    first, *rest = [line.rstrip() for line in captured.get().splitlines()]
    assert first == "3 cells, 0 of them finished before"
    assert rest[0] == f"cgp-s0: another process trains it, on {platform.node()}"
    assert not any("3/3" in line or "done" in line for line in rest)


def test_a_cluster_without_ray_is_refused_with_how_to_install_it(tmp_path: Path) -> None:
    hidden = "import sys; sys.modules['ray'] = None; from conflow.__main__ import main; main()"
    command = [sys.executable, "-c", hidden, *GRID, "cluster=auto"]
    refused = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert refused.returncode == 2
    assert refused.stderr == (
        "conflow: cluster=auto: found no Ray, expected the extra `cluster`; try: pip install '.[cluster]'\n"
    )
    assert not list(tmp_path.iterdir())


def test_a_cells_progress_is_what_its_process_says_of_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its stages follow one another: training is 0.9 of the whole, sampling of either split half of the rest."""
    cell = Job([], config.load(), progress=tmp_path / "progress")
    cell.look(progress.read(tmp_path / "progress"))
    assert (cell.share, cell.note) == (0.0, ""), "it has said nothing yet"
    monkeypatch.setenv(progress.FILE, str(cell.progress))
    stages = {
        ("training", 400): (100, 0.225),
        ("sampling test", 3): (2, 0.9 + 0.1 / 3),
        ("sampling validation", 3): (3, 1),
    }
    for (name, total), (completed, share) in stages.items():
        monkeypatch.setattr(progress, "FILE_SECONDS", -1.0)
        with ProgressDisplay(Console(quiet=True)) as display:
            display.update(display.add(name, total), completed)
        cell.look(progress.read(tmp_path / "progress"))
        assert cell.share == pytest.approx(share)
        assert cell.note == f"{name} {completed}/{total}"
    (tmp_path / "progress").write_text("train")
    cell.look(progress.read(tmp_path / "progress"))
    assert cell.share == 1, "what is being written is read the next time"


def test_a_cell_that_was_only_being_started_is_ended_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not among the processes yet when the signal comes, and would train to its end."""
    started: list[subprocess.Popen[str]] = []
    popen = subprocess.Popen

    def slow(_: object, **options: Any) -> "subprocess.Popen[str]":
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1)
        started.append(popen([sys.executable, "-c", "import time; time.sleep(600)"], **options))
        return started[0]

    monkeypatch.setattr(subprocess, "Popen", slow)
    with raising_signals(), pytest.raises(signals.Interrupted, match="SIGTERM"):
        _train_all([Job([], config.load())], 1, Console(quiet=True))
    assert started[0].returncode == -signal.SIGTERM


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_cell_that_cannot_be_started_and_those_after_it_have_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    cells = [Job([], config.load()) for _ in range(3)]
    _train_all(cells, 1, Console(quiet=True))
    assert [cell.failed for cell in cells] == [True] * 3
