import os
import subprocess
import sys
from pathlib import Path

import pytest

from conflow.experiment import config
from conflow.experiment.grid import Cell, _listen

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
