import json
import os
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from mlflow.entities import Run

from tests.faults.processes import runs, store
from tests.test_train import artifacts
from tests.test_ui import free_port

# The smallest training that leaves everything that a training leaves.
TINY = ["preset=smoke", "train.max_steps=5", "train.val_every=5", "train.log_every=5"]
TINY += ["data.num=100", "sample.num=4", "sample.steps=2"]
LEFT = {"config.yaml", "model.ckpt", "figures/demonstrations.png", "figures/page.png", "figures/sources.png"}


def environment(uri: str | None) -> dict[str, str]:
    """The variables of this process, but with the store in the current folder or at `uri`."""
    rest = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    # Processes that share the cores would otherwise each start a thread for every core and crawl.
    return {"OMP_NUM_THREADS": "1", **rest, **({"MLFLOW_TRACKING_URI": uri} if uri else {})}


def started(
    folder: Path, *arguments: str, uri: str | None = None, output: IO[str] | int = subprocess.PIPE
) -> "subprocess.Popen[str]":
    """The command line at work in a folder."""
    command = [sys.executable, "-m", "conflow", *arguments]
    return subprocess.Popen(
        command, cwd=folder, env=environment(uri), text=True, stdout=output, stderr=subprocess.STDOUT
    )


@contextmanager
def stopped_afterwards(*processes: "subprocess.Popen[str]") -> Iterator[None]:
    """No process outlives the block, whatever happens in it."""
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            try:
                process.communicate(timeout=300)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def assert_complete(run: Run, steps: list[int]) -> None:
    """A finished run has the metrics of training, validation and test."""
    assert run.info.status == "FINISHED"
    expected = {f"test/{setting}/robot_collision_rate" for setting in ("none", "robot", "obstacle")}
    assert expected | {"train/loss", "val/loss", "without_model/data/robot_collision_count"} <= set(run.data.metrics)
    assert steps == [5]


def test_eight_trainings_started_at_once_on_no_store_all_finish(tmp_path: Path) -> None:
    trainings = [started(tmp_path, "train", *TINY, f"seed={seed}") for seed in range(8)]
    with stopped_afterwards(*trainings):
        outputs = [training.communicate(timeout=400)[0] for training in trainings]
    assert [training.returncode for training in trainings] == [0] * 8, "\n".join(outputs)
    done = runs(tmp_path)
    assert sorted(str(run.info.run_name) for run in done) == [f"cgp-s{seed}" for seed in range(8)]
    for run in done:
        history = store(tmp_path).get_metric_history(run.info.run_id, "train/loss")
        assert_complete(run, [metric.step for metric in history])
        assert {name for name in LEFT if (artifacts(run) / name).stat().st_size > 0} == LEFT
    # None has lost a metric to another.
    assert len({frozenset(run.data.metrics) for run in done}) == 1


# A process that makes the experiment and adds new data sets to its run, each when it is told to.
MAKE = """
import sys
from conflow.tracking import recording
from conflow.training import config
from conflow.tracking import store
from conflow.training.datamodule import DemonstrationData
from conflow.training.train import experiment

def wait():
    print("ready", flush=True)
    sys.stdin.readline()

store.EXPERIMENT = sys.argv[1]
wait()
client = store.client()
run = client.create_run(client.get_experiment_by_name(store.EXPERIMENT).experiment_id)
for seed in range(5):
    data = DemonstrationData(config.load([*sys.argv[2:], f"data.seed={seed}"]))
    wait()
    recording._log_dataset(client, run.info.run_id, experiment(data.config, data))
"""


def make_together(folders: Sequence[Path], experiment: str, uri: str | None = None) -> None:
    """A process in each folder makes the same experiment, then five data sets, at the same moment as the others."""
    command = ["timeout", "400", sys.executable, "-c", MAKE, experiment, *TINY]
    processes: list[subprocess.Popen[str]] = []
    for folder in folders:
        with (folder / f"errors {len(processes)}").open("w") as errors:
            process = subprocess.Popen(
                command,
                cwd=folder,
                env=environment(uri),
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
            )
        processes.append(process)
    with stopped_afterwards(*processes):
        for _ in range(6):
            said = [process.stdout.readline() for process in processes if process.stdout is not None]
            if said != ["ready\n"] * len(folders):
                break
            for process in processes:
                assert process.stdin is not None
                process.stdin.write("now\n")
                process.stdin.flush()
        else:
            for process in processes:
                process.wait(timeout=300)
    errors_said = "\n".join(path.read_text() for folder in folders for path in folder.glob("errors *"))
    assert [process.returncode for process in processes] == [0] * len(folders), errors_said


def test_processes_that_add_the_same_new_data_set_at_the_same_moment_do_not_fail_each_other(tmp_path: Path) -> None:
    make_together([tmp_path] * 3, "conflow")


def answered(address: str, question: Mapping[str, object] | None = None) -> bytes:
    """What the server answers to a GET, or to a POST of a question."""
    body = None if question is None else json.dumps(question).encode()
    request = urllib.request.Request(address, body, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=30) as answer:
        return bytes(answer.read())


def wait_for(address: str, server: "subprocess.Popen[str]") -> None:
    """Return when the server answers.

    Raises:
        AssertionError: it has ended, or does not within two minutes.
    """
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and server.poll() is None:
        try:
            answered(address)
        except (urllib.error.URLError, ConnectionError):
            time.sleep(0.3)
        else:
            return
    raise AssertionError(f"{address} does not answer")


def test_a_grid_finishes_while_the_pages_are_open_and_they_answer_throughout(tmp_path: Path) -> None:
    port = free_port()
    page = f"http://127.0.0.1:{port}"
    with (tmp_path / "ui.log").open("w") as log:  # a pipe that nobody reads would fill and stop the server
        ui = started(tmp_path, "ui", f"port={port}", output=log)
    longer = [TINY[0], "train.max_steps=500", *TINY[2:]]  # long enough to be looked at
    grid = started(tmp_path, "ablations", *longer, "seeds=0", "ablations=cgp fm")
    seen = set()
    with stopped_afterwards(ui, grid):
        wait_for(page, ui)
        found = answered(f"{page}/api/2.0/mlflow/experiments/get-by-name?experiment_name=conflow")
        question = {"experiment_ids": [json.loads(found)["experiment"]["experiment_id"]]}
        deadline = time.monotonic() + 400
        while grid.poll() is None and time.monotonic() < deadline:
            assert b"MLflow" in answered(page)
            found = answered(f"{page}/api/2.0/mlflow/runs/search", question)
            seen.add(tuple(run["info"]["status"] for run in json.loads(found).get("runs", [])))
            time.sleep(0.2)
        output, _ = grid.communicate(timeout=300)
        assert ui.poll() is None
    assert grid.returncode == 0, output
    assert [run.info.status for run in runs(tmp_path)] == ["FINISHED", "FINISHED"]
    # The newest run comes first: the pages showed the second one at work beside the first one's results.
    assert ("RUNNING", "FINISHED") in seen
