"""Of a run that another process has taken nothing is written any more by the first, which may live all the same."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from mlflow.entities import Run

from conflow.tracking import liveness, recording, store
from conflow.training import config
from conflow.training.datamodule import DemonstrationData
from conflow.training.train import experiment
from tests.faults import processes
from tests.faults.processes import history, runs, weights
from tests.faults.processes import store as store_of

TRAIN = (
    *("train", "preset=smoke", "data.num=200", "train.max_steps=41", "train.val_every=10", "train.log_every=7"),
    *("train.batch_size=16", "sample.num=8", "sample.steps=3"),
)
STEP = ("conflow.training.module", "Training.training_step")


class Attempt:
    """Arranges that a process works for an engine's task, beats often, and may stop at a step as if it were frozen."""

    def __init__(self, task: str = "", frozen_at: int = 0, beat: float = 60.0, expiry: float = 600.0) -> None:
        self.task, self.frozen_at, self.beat, self.expiry = task, frozen_at, beat, expiry

    def __call__(self) -> None:
        liveness.BEAT, liveness.EXPIRY = self.beat, self.expiry
        if self.task:
            os.environ[liveness.ENGINE_TASK] = self.task
        if self.frozen_at:
            # Every flush writes, so that what is written after the thaw would be seen.
            recording.FLUSH_SECONDS = 0.0
            _before(*STEP, self.frozen_at, _freeze_between_beats())


def _freeze_between_beats() -> Callable[[], None]:
    """Stops the process, but not in the middle of a beat: nobody else could use an SQLite file that it then locks."""
    beating, original = threading.Lock(), liveness.Claim._beat

    def beat(claim: liveness.Claim) -> None:
        with beating:
            original(claim)

    def freeze() -> None:
        with beating:
            os.kill(os.getpid(), signal.SIGSTOP)

    liveness.Claim._beat = beat  # type: ignore[method-assign, assignment]
    return freeze


def _before(module: str, name: str, call: int, act: Callable[[], None]) -> None:
    import importlib

    owner: Any = getattr(importlib.import_module(module), name.split(".")[0])
    original, calls = getattr(owner, name.split(".")[1]), [0]

    def wrapped(*positional: Any, **named: Any) -> Any:
        calls[0] += 1
        if calls[0] == call:
            act()
        return original(*positional, **named)

    setattr(owner, name.split(".")[1], wrapped)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("liveness")


@pytest.fixture(scope="module")
def whole(folder: Path) -> Run:
    """The run that nothing disturbs."""
    code, output = processes.run(folder, *TRAIN)
    assert code == 0, output
    return runs(folder)[0]


def frozen(folder: Path, attempt: Attempt) -> Any:
    """A process that has stopped in the middle of its training, alive and silent."""
    process = processes.start(folder, *TRAIN, death=attempt)
    deadline = time.monotonic() + 180
    while time.monotonic() < deadline:
        if Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T":
            return process
        time.sleep(0.2)
    process.kill()
    raise TimeoutError((folder / "output").read_text())


def thawed(folder: Path, process: Any) -> tuple[int, str]:
    """Exit code and output of a process that goes on where it was frozen; its output file is another by now."""
    os.kill(process.pid, signal.SIGCONT)
    process.join(120)
    if process.is_alive():
        process.kill()
        raise TimeoutError
    return process.exitcode, (folder / "first").read_text()


def assert_as_undisturbed(whole: Run, folder: Path, run_id: str) -> None:
    """One run, whose weights and history are the undisturbed one's, each point once."""
    run = store_of(folder).get_run(run_id)
    assert run.info.status == "FINISHED"
    assert run.data.tags["resumed"] == "1"
    assert all(torch.equal(tensor, weights(whole)[name]) for name, tensor in weights(run).items())
    assert history(folder, run) == history(folder, whole)


@pytest.mark.skipif(not Path("/proc").exists(), reason="no /proc to see in that a process is stopped")
@pytest.mark.parametrize("by", ["engine's task", "its beats"])
def test_a_run_is_taken_from_a_frozen_process_which_then_ends_itself(by: str, folder: Path, whole: Run) -> None:
    """An attempt that was given up but lives: what a cut network and a suspended machine look like from outside."""
    first = (
        Attempt(task="task 1", frozen_at=15)
        if by == "engine's task"
        else Attempt(frozen_at=15, beat=0.5, expiry=3.0)  # short, so that the test need not wait ten minutes
    )
    process = frozen(folder, first)
    try:
        (folder / "output").rename(folder / "first")
        run_id = str(runs(folder)[0].info.run_id)
        assert store_of(folder).get_run(run_id).info.status == "RUNNING"
        if by == "its beats":
            # Its lock is held, which on the same machine says that it lives; of another's only beats are known.
            store_of(folder).set_tag(run_id, "host", "elsewhere")
            time.sleep(3.0)
        code, output = processes.run(folder, *TRAIN, "resume=latest", death=Attempt(task=first.task))
        assert code == 0, output
        assert_as_undisturbed(whole, folder, run_id)
        code, output = thawed(folder, process)
    finally:
        process.kill()
        process.join()
    assert code == 2, output
    assert output.splitlines()[-1].startswith("conflow: run cgp-s0: found that ")
    assert output.splitlines()[-1].endswith("goes on with it; this process ends and leaves it alone")
    assert_as_undisturbed(whole, folder, run_id)
    assert not list((folder / "runs" / "running").iterdir())


def test_a_process_whose_engine_has_lost_its_worker_ends_its_run(folder: Path, whole: Run) -> None:
    """An orphan would train on beside the next attempt."""
    endless = [*TRAIN, "train.max_steps=1000000", "train.val_every=1000000", "seed=3"]
    worker = f"""
import subprocess, sys, time
subprocess.Popen({[sys.executable, "-m", "conflow", *endless]!r}, start_new_session=True)
time.sleep(600)
"""
    environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    parent = subprocess.Popen(
        [sys.executable, "-c", worker], cwd=folder, env=environment | {liveness.ENGINE_TASK: "task 3"}
    )
    deadline = time.monotonic() + 180
    try:
        while not any("train/loss" in run.data.metrics for run in runs(folder) if run.info.run_name == "cgp-s3"):
            assert time.monotonic() < deadline
            time.sleep(0.3)
    finally:
        parent.kill()
        parent.wait()
    while (run := runs(folder)[0]).info.status == "RUNNING" and time.monotonic() < deadline:
        time.sleep(0.3)
    assert run.info.status == "KILLED"
    assert liveness.NOTE not in run.data.tags, "it said so itself"


@pytest.fixture
def begun(folder: Path, whole: Run, monkeypatch: pytest.MonkeyPatch) -> recording.Experiment:
    """An experiment, and the store as the current one."""
    monkeypatch.chdir(folder)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    settings = config.load(["preset=smoke", "data.num=200"])
    return experiment(settings, DemonstrationData(settings))


def test_a_run_beats_and_is_alive_to_other_machines_until_ten_minutes_after(
    begun: recording.Experiment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(liveness, "BEAT", 0.2)
    with recording.start(begun) as logger:
        run_id = str(logger.run_id)
        first = logger.store.get_run(run_id)
        assert 590 < float(first.data.tags["alive_until"]) - time.time() <= 601  # whole seconds, rounded
        deadline = time.monotonic() + 30
        while (later := logger.store.get_run(run_id)).data.tags["alive_until"] == first.data.tags["alive_until"]:
            assert time.monotonic() < deadline, "it does not beat"
            time.sleep(0.2)
        running, now = store.RUNS / "running", time.time()
        later.data.tags["host"] = "elsewhere"
        with monkeypatch.context() as patch:
            patch.setattr(liveness, "_held", set())  # as another process sees it
            assert liveness.is_alive(later, running)
            patch.setattr(time, "time", lambda: now + 700)
            assert not liveness.is_alive(later, running)
            later.data.tags.pop("alive_until")  # as a run of before there were beats: nothing can be known of it
            assert liveness.is_alive(later, running)


@pytest.mark.parametrize("taken", ["lock", "status"])
def test_nothing_is_written_to_a_run_that_is_anothers(taken: str, begun: recording.Experiment) -> None:
    """Neither a metric, nor an artifact, nor its end."""

    def lose() -> None:
        with recording.start(begun) as logger:
            ids.append(str(logger.run_id))
            logger.log_metrics({"train/loss": 0.5}, 1)
            logger.save()
            if taken == "lock":
                logger.store.set_tag(ids[0], "lock", "another's")
            else:
                logger.store.set_terminated(ids[0], "KILLED")
            logger.log_metrics({"train/loss": 0.25}, 2)
            with pytest.raises(liveness.LostRunError):
                logger.log_files(str(store.RUNS / "running"))

    ids: list[str] = []
    with pytest.raises(liveness.LostRunError, match="this process ends and leaves it alone"):
        lose()
    client = store_of(Path())
    assert client.get_run(ids[0]).info.status == ("RUNNING" if taken == "lock" else "KILLED")
    assert [point.step for point in client.get_metric_history(ids[0], "train/loss")] == [1]
