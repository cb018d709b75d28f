"""MLflow: the store, a run's life from start to end, and a Lightning logger that writes in batches."""

import logging
import os
import platform
import sqlite3
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock
from lightning.pytorch.loggers import MLFlowLogger
from mlflow import MlflowClient
from mlflow.artifacts import download_artifacts
from mlflow.data.numpy_dataset import from_numpy
from mlflow.entities import DatasetInput, InputTag, Metric, Param, Run

from conflow.experiment.config import Config, ConfigError, flatten, nearest
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.signals import Interrupted, held

# MLflow tells every user about every table of a new store,
logging.getLogger("mlflow.store.db.utils").setLevel(logging.WARNING)
# and shows a bar for every file that it copies.
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")

EXPERIMENT = "conflow"
RUNS = Path("runs")
FLUSH_SECONDS = 5.0


def local_uri() -> str:
    """The SQLite file under runs/."""
    return f"sqlite:///{(RUNS / 'mlflow.db').absolute()}"


def store_uri() -> str:
    """MLFLOW_TRACKING_URI, or the SQLite file under runs/."""
    return os.environ.get("MLFLOW_TRACKING_URI") or local_uri()


def client() -> MlflowClient:
    """A client of the store, which is made together with the experiment where it is missing."""
    RUNS.mkdir(parents=True, exist_ok=True)
    local = store_uri() == local_uri()
    artifacts = (RUNS / "artifacts").absolute().as_uri() if local else None
    # Two processes that migrate a new SQLite file at once break it.
    with FileLock(RUNS / ".store.lock"):
        store = MlflowClient(store_uri())
        experiment = store.get_experiment_by_name(EXPERIMENT)
        if experiment is None:
            store.create_experiment(EXPERIMENT, artifacts)
        elif local and experiment.artifact_location != artifacts:
            _relocate(str(experiment.artifact_location), str(artifacts))
    return store


def _relocate(old: str, new: str) -> None:
    """Follow a runs/ folder that was moved: MLflow keeps artifact locations absolute and cannot change them."""
    with closing(sqlite3.connect(RUNS / "mlflow.db")) as database, database:
        database.execute("UPDATE experiments SET artifact_location = ? WHERE artifact_location = ?", (new, old))
        database.execute(
            "UPDATE runs SET artifact_uri = ? || substr(artifact_uri, ?) WHERE artifact_uri LIKE ? || '/%'",
            (new, len(old) + 1, old),
        )


def find_run(wanted: str) -> Run:
    """The run with this id, or the newest finished one of this name, or of any for "latest".

    Raises:
        ConfigError: there is none.
    """
    store = client()
    experiment = store.get_experiment_by_name(EXPERIMENT)
    assert experiment is not None
    finished = store.search_runs(
        [experiment.experiment_id], "attributes.status = 'FINISHED'", order_by=["attributes.start_time DESC"]
    )
    for run in finished:
        if wanted in ("latest", run.info.run_id, run.info.run_name):
            return run
    known = sorted({str(run.info.run_name) for run in finished})
    raise ConfigError(
        f"run={wanted}: no such finished run, expected latest, an id or a name{nearest(wanted, known)}"
        if known
        else f"run={wanted}: no run has finished yet, expected one; try: make train"
    )


def artifact(run: Run, name: str) -> Path:
    """The local path of a run's artifact, fetched where the store is remote."""
    return Path(download_artifacts(run_id=run.info.run_id, artifact_path=name, tracking_uri=store_uri()))


class RunLogger(MLFlowLogger):
    """Lightning's MLflow logger, except that metrics are written in batches and the run's status is left alone."""

    def __init__(self, store: MlflowClient, run_id: str) -> None:
        super().__init__(EXPERIMENT, tracking_uri=store_uri(), run_id=run_id)
        self.store = store
        self.buffer: list[Metric] = []
        self.flushed = time.monotonic()

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        now = int(time.time() * 1000)
        self.buffer += [Metric(key, float(value), now, step or 0) for key, value in metrics.items() if key != "epoch"]
        if time.monotonic() - self.flushed > FLUSH_SECONDS:
            self.save()

    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        """`start` has logged the whole config."""

    def save(self) -> None:
        """Write what is buffered."""
        for i in range(0, len(self.buffer), 1000):
            self.store.log_batch(str(self.run_id), metrics=self.buffer[i : i + 1000])
        self.buffer.clear()
        self.flushed = time.monotonic()

    def finalize(self, status: str = "success") -> None:
        self.save()


@contextmanager
def start(config: Config, data: DemonstrationData) -> Iterator[RunLogger]:
    """A run `<ablation>-s<seed>` with its params, tags and data set, which ends with the status that is true.

    FINISHED when the block ends, KILLED when a signal interrupts it, FAILED when it raises.
    """
    store = client()
    experiment = store.get_experiment_by_name(EXPERIMENT)
    assert experiment is not None
    name, tags, status = f"{config.ablation}-s{config.seed}", _tags(config), "FAILED"
    logger: RunLogger | None = None
    try:
        # A signal between the store's commit and its answer would leave a run that nobody knows of to end.
        with held():
            run_id = store.create_run(experiment.experiment_id, run_name=name, tags=tags).info.run_id
            logger = RunLogger(store, run_id)
        params = [Param(key, str(value)) for key, value in flatten(config.tree()).items()]
        store.log_batch(run_id, params=params)
        store.log_dict(run_id, config.tree(), "config.yaml")
        _log_dataset(store, run_id, data)
        yield logger
        status = "FINISHED"
    except Interrupted:
        status = "KILLED"
        raise
    finally:
        if logger is not None:
            logger.save()
            store.set_terminated(run_id, status)


def _tags(config: Config) -> dict[str, str]:
    sha, dirty = _git("rev-parse", "HEAD"), _git("status", "--porcelain")
    return {
        "ablation": config.ablation,
        "preset": config.preset,
        "seed": str(config.seed),
        "git_sha": sha if sha is not None else "unknown",
        "git_dirty": str(bool(dirty)).lower() if dirty is not None else "unknown",
        "config_sha": config.sha(),
        "host": platform.node(),
        "pid": str(os.getpid()),
    }


def _git(*arguments: str) -> str | None:
    folder = Path(__file__).parent
    try:
        result = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() if result.returncode == 0 else None


def _log_dataset(store: MlflowClient, run_id: str, data: DemonstrationData) -> None:
    name = Path(data.config.data.path).name if data.config.data.path else "generated swaps"
    dataset = from_numpy(data.x.numpy(), targets=data.violates.numpy(), name=name, digest=data.digest)
    store.log_inputs(run_id, [DatasetInput(dataset._to_mlflow_entity(), [InputTag("mlflow.data.context", "training")])])
    description = {
        "data_digest": data.digest,
        "data_violating_share": f"{data.violates.float().mean():.4f}",
        **{f"data_{split}": len(getattr(data, split).x) for split in ("train", "val", "test")},
    }
    for key, value in description.items():
        store.set_tag(run_id, key, value)
