import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mlflow import MlflowClient

from conflow.experiment import config
from conflow.experiment.grid import Cell, _listen
from conflow.scene.constraint import RobotAvoidance
from conflow.scene.robots import PointRobots
from conflow.scene.trajectories import swap

GRID = ["ablations", "preset=smoke", "seeds=0", "ablations=cgp fm"]


def grid(folder: Path, *arguments: str) -> "subprocess.Popen[str]":
    environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    command = [sys.executable, "-m", "conflow", *GRID, *arguments]
    return subprocess.Popen(
        command, cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )


def statuses(folder: Path) -> list[tuple[str, str]]:
    """Name and status of every run, the oldest first."""
    if not (folder / "runs" / "mlflow.db").exists():
        return []
    store = MlflowClient(f"sqlite:///{folder / 'runs' / 'mlflow.db'}")
    experiment = store.get_experiment_by_name("conflow")
    runs = store.search_runs([experiment.experiment_id], order_by=["attributes.start_time ASC"]) if experiment else []
    return [(str(run.info.run_name), str(run.info.status)) for run in runs]


def test_an_interrupted_grid_goes_on_where_it_stopped(tmp_path: Path) -> None:
    stopped = grid(tmp_path)
    assert stopped.stdout is not None
    # The grid has made the store when it says this; to look at it earlier would race with its migration.
    assert stopped.stdout.readline().strip() == "2 cells, 0 of them finished before"
    deadline = time.monotonic() + 120
    # The second cell has begun: the first one is finished and must not be trained again.
    while len(statuses(tmp_path)) < 2 and time.monotonic() < deadline:
        time.sleep(0.3)
    stopped.send_signal(signal.SIGINT)
    output, _ = stopped.communicate(timeout=60)
    assert stopped.returncode == 128 + signal.SIGINT, output
    assert statuses(tmp_path) == [("cgp-s0", "FINISHED"), ("fm-s0", "KILLED")]
    resumed = grid(tmp_path)
    output, _ = resumed.communicate(timeout=120)
    assert resumed.returncode == 0, output
    assert "2 cells, 1 of them finished before" in output
    assert "Table 1" in output
    assert statuses(tmp_path) == [("cgp-s0", "FINISHED"), ("fm-s0", "KILLED"), ("fm-s0", "FINISHED")]


def test_one_failed_cell_does_not_lose_the_others(tmp_path: Path) -> None:
    x = swap(600)
    feasible = x[~RobotAvoidance(PointRobots(2)).violation(x)]
    np.savez(tmp_path / "feasible.npz", x=feasible.numpy())
    failing = grid(tmp_path, "data.path=feasible.npz")
    output, _ = failing.communicate(timeout=120)
    assert failing.returncode == 2
    assert "cgp-s0 failed: conflow: data.path=feasible.npz: no trajectory for training violates" in output
    assert "1 cells failed" in output
    assert statuses(tmp_path) == [("fm-s0", "FINISHED")]


@pytest.mark.parametrize("argument", ["ablations=cgp cpg", "seeds=0 x", "jobs=0", "sedes=0 1"])
def test_a_grid_with_a_mistyped_cell_is_refused_before_any_is_started(argument: str, tmp_path: Path) -> None:
    refused = grid(tmp_path, argument)
    output, _ = refused.communicate(timeout=60)
    assert refused.returncode == 2
    assert len(output.splitlines()) == 1
    assert not (tmp_path / "runs" / "mlflow.db").exists()


def test_a_cells_progress_is_read_from_what_it_prints() -> None:
    cell = Cell([], config.load())
    for line, share in {
        "training 100/400  loss 0.1  9 s left": 0.225,
        "sampling 2/3  setting robot": 0.9 + 0.2 / 3,
    }.items():
        _listen(cell, line)
        assert cell.share == pytest.approx(share)
    _listen(cell, "conflow: something else")
    assert cell.output[-1] == "conflow: something else"
