"""A grid that is interrupted, and one of whose cells fails."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import conflow
from conflow.scene.tasks.swap import swap
from tests.faults import processes
from tests.faults.processes import runs
from tests.papers import keep_apart

GRID = ("ablations", "preset=smoke", "seeds=0", "ablations=cgp fm")


def statuses(folder: Path) -> list[tuple[str, str]]:
    """Name and status of every run, the oldest first."""
    if not (folder / "runs" / "mlflow.db").exists():
        return []
    return [(str(run.info.run_name), str(run.info.status)) for run in reversed(runs(folder))]


def test_an_interrupted_grid_goes_on_where_it_stopped(tmp_path: Path) -> None:
    longer = (*GRID, "train.max_steps=5000", "train.val_every=2500")
    stopped = processes.start(tmp_path, *longer)
    deadline = time.monotonic() + 180
    # Then its first cell makes the store.
    output = tmp_path / "output"
    while not (output.exists() and "2 cells, 0 of them" in output.read_text()) and time.monotonic() < deadline:
        time.sleep(0.3)
    # The second cell has begun: the first one is finished and must not be trained again.
    while len(statuses(tmp_path)) < 2 and time.monotonic() < deadline:
        time.sleep(0.3)
    os.kill(stopped.pid, signal.SIGINT)
    stopped.join(180)
    assert stopped.exitcode == 128 + signal.SIGINT, output.read_text()
    assert statuses(tmp_path) == [("cgp-s0", "FINISHED"), ("fm-s0", "KILLED")]
    code, said = processes.run(tmp_path, *longer)
    assert code == 0, said
    assert "2 cells, 1 of them finished before" in said
    assert "Table 1" in said
    # The same run went on.
    assert statuses(tmp_path) == [("cgp-s0", "FINISHED"), ("fm-s0", "FINISHED")]
    assert runs(tmp_path)[0].data.tags["resumed"] == "1"


def test_a_cell_that_died_as_it_was_begun_goes_on_as_the_same_run(tmp_path: Path) -> None:
    begun = ("train", "preset=smoke", "ablation=fm", "seed=0")
    death = processes.killed_in("conflow.tracking.recording", "_describe")
    assert processes.run(tmp_path, *begun, death=death)[0] == -signal.SIGKILL
    code, said = processes.run(tmp_path, "ablations", "preset=smoke", "seeds=0", "ablations=fm")
    assert code == 0, said
    assert statuses(tmp_path) == [("fm-s0", "FINISHED")]


def test_changed_code_is_trained_anew_and_a_changed_comment_is_not(tmp_path: Path) -> None:
    """A sign that is flipped in the method, in a copy of the program."""
    root = Path(conflow.__file__).parents[1]
    for part in ("conflow", "conf"):
        shutil.copytree(root / part, tmp_path / part)
    correction = tmp_path / "conflow" / "flow" / "correction.py"
    text = correction.read_text()
    assert text.count("return along(self") == 1
    flipped = text.replace("return along(self", "return -along(self")
    expected = {
        text: ["1 cells, 0 of them finished before"],
        f"# A comment.\n{text}": ["1 cells, 1 of them finished before"],
        flipped: ["1 cells, 0 of them finished before", "cgp-s0: trained by other code: flow/correction.py"],
        text.replace("u^c", "the correction"): ["1 cells, 1 of them finished before"],  # the first run is still there
    }
    grid = [sys.executable, "-m", "conflow", "ablations", "preset=smoke", "seeds=0", "ablations=cgp"]
    environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    environment["PYTHONPATH"] = str(tmp_path)
    for content, said in expected.items():
        correction.write_text(content)
        done = subprocess.run(grid, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert [line.rstrip() for line in done.stdout.splitlines()[: len(said)]] == said
        assert "other code than the present" not in done.stdout
    old, new = (run.data.metrics["train/loss"] for run in runs(tmp_path))
    assert old != new


def test_one_failed_cell_does_not_lose_the_others(tmp_path: Path) -> None:
    x = swap(600)
    feasible = x[~keep_apart(2).violation(x)]
    np.savez(tmp_path / "feasible.npz", x=feasible.numpy())
    code, output = processes.run(tmp_path, *GRID, "data.path=feasible.npz")
    assert code == 2
    assert "cgp-s0 failed: conflow: data.path=feasible.npz: no trajectory for training violates" in output
    assert "1 cells failed" in output
    assert statuses(tmp_path) == [("fm-s0", "FINISHED")]
