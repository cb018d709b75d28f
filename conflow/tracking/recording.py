"""A run from its start to its end, and a Lightning logger that writes in batches."""

import math
import os
import platform
import re
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from lightning.pytorch.loggers import MLFlowLogger
from mlflow import MlflowClient
from mlflow.data.numpy_dataset import from_numpy
from mlflow.entities import DatasetInput, InputTag, Metric, Param, Run
from mlflow.exceptions import MlflowException

from conflow import __version__
from conflow.errors import ConfigError
from conflow.tracking import carried, code, liveness, signals
from conflow.tracking.signals import held
from conflow.tracking.store import EXPERIMENT, RUNS, checkpoints, client, store_uri, whole

CONFIG_FILE = "config.yaml"
FLUSH_SECONDS = 5.0
LIBRARIES = ("torch", "numpy", "scipy", "lightning", "torchmetrics", "mlflow", "omegaconf")
"""Whose versions decide numbers, or what is stored of them."""


@dataclass(frozen=True)
class Experiment:
    """What a run is of.

    Attributes:
        name: the run's.
        tags: what runs are found by; `config_sha` and `data_digest` say which experiment it is.
        params: its settings, as text.
        settings: all of them as nested plain values, for `config.yaml`.
        dataset: the name of its demonstrations.
        x: the demonstrations, (N, T, D).
        violates: their labels, boolean (N,).
    """

    name: str
    tags: dict[str, str]
    params: dict[str, str]
    settings: dict[str, Any]
    dataset: str
    x: np.ndarray
    violates: np.ndarray


class RunLogger(MLFlowLogger):
    """Lightning's MLflow logger, except that metrics are written in batches and the run's status is left alone.

    Args:
        store: where the run is.
        run_id: the run.
        again: what the store has of a step already is not written a second time. A run that goes on from a checkpoint
            repeats the steps after it, with the same results.
        claim: this process's hold on the run, without which nothing is written; none on a finished run, which is
            anybody's to add to.
    """

    def __init__(
        self, store: MlflowClient, run_id: str, again: bool = False, claim: liveness.Claim | None = None
    ) -> None:
        super().__init__(EXPERIMENT, tracking_uri=store_uri(), run_id=run_id)
        self.store, self.claim = store, claim
        _ = self.experiment  # Lightning asks the store about it once: here, where no signal interrupts
        keys = store.get_run(run_id).data.metrics if again else ()
        self.written = {(key, point.step) for key in keys for point in store.get_metric_history(run_id, key)}
        self.buffer: list[Metric] = []
        self.flushed = time.monotonic()
        self.began: float | None = None
        self.carried, self.carries = -math.inf, 0

    def count(self, before: float) -> None:
        """Keep from now on the tag `seconds`, for how long the run has been at work; `before` is what it has by now."""
        self.began = time.monotonic() - before

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        now = int(time.time() * 1000)
        self.buffer += [
            Metric(key, float(value), now, step or 0)
            for key, value in metrics.items()
            if key != "epoch" and (key, step or 0) not in self.written
        ]
        if time.monotonic() - self.flushed > FLUSH_SECONDS:
            self.save()

    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """`start` has logged the whole config."""

    def save(self) -> None:
        """Write what is buffered, and up to when the run was at work.

        Raises:
            LostRunError: the run is no longer this process's; nothing is written.
        """
        with whole():
            self._check()
            for i in range(0, len(self.buffer), 1000):
                self.store.log_batch(str(self.run_id), metrics=self.buffer[i : i + 1000])
            if self.began is not None:
                self.store.set_tag(str(self.run_id), "seconds", f"{time.monotonic() - self.began:.3f}")
            self.buffer.clear()
            self.flushed = time.monotonic()

    def log_files(self, folder: str) -> None:
        """Make everything in a folder an artifact of the run."""
        with whole():
            self._check()
            self.store.log_artifacts(str(self.run_id), folder)

    def after_save_checkpoint(self, checkpoint_callback: Any) -> None:
        """Carry the checkpoint that was just saved, where that is asked for and was not done in the last minute."""
        if carried.asked() and time.monotonic() - self.carried > carried.SECONDS:
            with whole():
                self._check()
                carried.put(self.store, str(self.run_id), Path(checkpoint_callback.path), self.carries)
            self.carried, self.carries = time.monotonic(), self.carries + 1

    def finalize(self, status: str = "success") -> None:
        self.save()

    def _check(self) -> None:
        if self.claim is not None:
            self.claim.check()


@contextmanager
def start(experiment: Experiment, resumed: Run | None = None) -> Iterator[RunLogger]:
    """A run of an experiment, with its params, tags and data set, which ends with the status that is true.

    FINISHED when the block ends, KILLED when a signal interrupts it, FAILED when it raises. What not even gets to
    say so, a process killed or a machine without power, is marked by the next `client`. A run that another process has
    taken meanwhile is left alone.

    Args:
        experiment: what it is of.
        resumed: the interrupted run to go on with, in place of a new one.

    Raises:
        ConfigError: another process goes on with it already.
        LostRunError: another process has taken it.
    """
    store = client()
    logger: RunLogger | None = None
    status = "FINISHED"
    with liveness.claim(RUNS / "running") as claim:
        try:
            # A signal between the store's commit and its answer would leave a run that nobody knows of to end.
            with held():
                run_id = _create(store, experiment, claim) if resumed is None else _reopen(store, resumed, claim)
                claim.keep(store, run_id)
                logger = RunLogger(store, run_id, again=resumed is not None, claim=claim)
                logger.count(at_work(resumed) if resumed else 0.0)
            with whole():
                _describe(store, run_id, experiment)
            yield logger
            signals.check()
        except BaseException:
            status = "KILLED" if signals.arrived() else "FAILED"
            raise
        finally:
            if logger is not None:
                _end(logger, status)


def _create(store: MlflowClient, experiment: Experiment, claim: liveness.Claim) -> str:
    folder = store.get_experiment_by_name(EXPERIMENT)
    assert folder is not None
    # With the run at once, not after it: by these tags it is found again, however early it is interrupted.
    tags = {**experiment.tags, "pid": str(os.getpid()), "seconds": "0", **code.tags(), **origin(), **claim.tags()}
    return str(store.create_run(folder.experiment_id, run_name=experiment.name, tags=tags).info.run_id)


def _reopen(store: MlflowClient, run: Run, claim: liveness.Claim) -> str:
    run_id, tags = str(run.info.run_id), run.data.tags
    running = ConfigError(f"resume={run.info.run_name}: expected an interrupted run, found one that is RUNNING")
    with FileLock(RUNS / ".store.lock"):
        if store.get_run(run_id).info.status == "RUNNING":
            raise running
        again = {"pid": str(os.getpid()), "resumed": str(int(tags.get("resumed", 0)) + 1)}
        # Of the attempts on several machines each is named.
        machines = {"hardware": hardware(), "threads": str(torch.get_num_threads()), "hosts": platform.node()}
        before = {"hosts": tags.get("host"), **tags}
        machines = {key: _also(before.get(key), value) for key, value in machines.items()}
        engine = {"engine_task": "none"} if "engine_task" in tags else {}  # unless it is an engine that goes on
        for key, value in (engine | claim.tags() | again | machines | code.tags_after(tags)).items():
            store.set_tag(run_id, key, value)
        # Of two machines that the file lock does not keep apart the one goes on that wrote its lock last.
        if store.get_run(run_id).data.tags["lock"] != claim.lock:
            raise running
        if tags.get(liveness.NOTE) == liveness.GONE:  # no longer true of it
            store.delete_tag(run_id, liveness.NOTE)
        store.update_run(run_id, status="RUNNING")
    return run_id


def _also(before: str | None, now: str) -> str:
    """What a tag says of all attempts at a run, each thing once."""
    return "; ".join(dict.fromkeys([*(before.split("; ") if before else []), now]))


def at_work(run: Run) -> float:
    """The seconds that a run was trained and evaluated, without those between an interruption and its resumption.

    Of a process that was killed what came after its last write is missing. A run of before this was counted says from
    when to when it was there.
    """
    if "seconds" in run.data.tags:
        return float(run.data.tags["seconds"])
    return float(run.info.end_time - run.info.start_time) / 1000


def _describe(store: MlflowClient, run_id: str, experiment: Experiment) -> None:
    store.log_batch(run_id, params=[Param(key, value) for key, value in experiment.params.items()])
    store.log_dict(run_id, experiment.settings, CONFIG_FILE)
    _log_dataset(store, run_id, experiment)


def _end(logger: RunLogger, status: str) -> None:
    run_id = str(logger.run_id)
    with whole():
        try:
            logger.save()
            logger.store.set_terminated(run_id, status)
            if status == "FINISHED":  # what such a run needs is among its artifacts
                shutil.rmtree(checkpoints(run_id), ignore_errors=True)
                carried.remove(logger.store, run_id)
        except Exception:
            # What ended the run is what its user must hear of; a later command marks it.
            if status == "FINISHED":
                raise


def origin() -> dict[str, str]:
    """What is at work: this program's revision, its version and those of its libraries, the hardware."""
    # An installed package may lie in a repository that is not its own, such as its user's.
    ours = _git("ls-files", "--error-unmatch", Path(__file__).name) is not None
    sha, dirty = (_git("rev-parse", "HEAD"), _git("status", "--porcelain")) if ours else (None, None)
    return {
        "git_sha": sha if sha is not None else "unknown",
        "git_dirty": str(bool(dirty)).lower() if dirty is not None else "unknown",
        "versions": ", ".join(f"{name} {number}" for name, number in versions().items()),
        "hardware": hardware(),
        "threads": str(torch.get_num_threads()),
    }


def versions() -> dict[str, str]:
    """Of this program, of Python, and of the libraries that decide what a run is like."""
    ours = {"conflow": __version__, "python": platform.python_version()}
    return ours | {name: version(name) for name in LIBRARIES}


def hardware() -> str:
    """The processor, how many cores it has, and the accelerator."""
    names = Path("/proc/cpuinfo")
    models = re.findall(r"model name\s*: (.*)", names.read_text()) if names.exists() else []
    cpu = f"{models[0] if models else platform.machine()}, {os.cpu_count()} cores"
    return f"{cpu}, {torch.cuda.get_device_name()}" if torch.cuda.is_available() else cpu


def _git(*arguments: str) -> str | None:
    folder = Path(__file__).parent
    try:
        result = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() if result.returncode == 0 else None


def _log_dataset(store: MlflowClient, run_id: str, experiment: Experiment) -> None:
    digest = experiment.tags["data_digest"]
    dataset = from_numpy(experiment.x, targets=experiment.violates, name=experiment.dataset, digest=digest)
    inputs = [DatasetInput(dataset._to_mlflow_entity(), [InputTag("mlflow.data.context", "training")])]
    try:
        store.log_inputs(run_id, inputs)
    except MlflowException:
        # Of two runs that add the same new data set at once MLflow fails the slower one; by now the data set is there.
        store.log_inputs(run_id, inputs)
