"""MLflow: the store, a run's life from start to end, and a Lightning logger that writes in batches."""

import logging
import os
import platform
import re
import shutil
import socket
import sqlite3
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import torch
from filelock import FileLock
from lightning.pytorch.loggers import MLFlowLogger
from mlflow import MlflowClient
from mlflow.artifacts import download_artifacts
from mlflow.data.numpy_dataset import from_numpy
from mlflow.entities import DatasetInput, InputTag, Metric, Param, Run
from mlflow.exceptions import MlflowException

from conflow import __version__
from conflow.experiment import alive, code, signals
from conflow.experiment.config import Config, ConfigError, flatten, nearest
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.signals import held

# MLflow tells every user about every table of a new store,
logging.getLogger("mlflow.store.db.utils").setLevel(logging.WARNING)
# and shows a bar for every file that it copies.
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
# Nor need it print a run's address on a server when the run ends, after what the command itself says last.
os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")

EXPERIMENT = "conflow"
CONFIG_FILE = "config.yaml"
MOST = 50_000
"""Runs that a search may return: as many as MLflow allows."""
RUNS = Path("runs")
FLUSH_SECONDS = 5.0


def local_uri() -> str:
    """The SQLite file under runs/."""
    return f"sqlite:///{(RUNS / 'mlflow.db').absolute()}"


def store_uri() -> str:
    """MLFLOW_TRACKING_URI, or the SQLite file under runs/."""
    return os.environ.get("MLFLOW_TRACKING_URI") or local_uri()


def client() -> MlflowClient:
    """A client of the store, which is made together with the experiment where it is missing.

    Runs whose process is gone are marked on the way, so that from here on none says RUNNING that is dead.
    """
    RUNS.mkdir(parents=True, exist_ok=True)
    _check_reachable(store_uri())
    local = store_uri() == local_uri()
    # A server decides itself where artifacts go.
    artifacts = None if store_uri().startswith("http") else (RUNS / "artifacts").absolute().as_uri()
    # Two processes that migrate a new SQLite file at once break it.
    with FileLock(RUNS / ".store.lock"), whole():
        if local and not (RUNS / "mlflow.db").exists():
            _make_store()
        store = MlflowClient(store_uri())
        experiment = store.get_experiment_by_name(EXPERIMENT)
        if experiment is None:
            _create_experiment(store, artifacts)
            return store
        if local and experiment.artifact_location != artifacts:
            _relocate(str(experiment.artifact_location), str(artifacts))
        alive.mark_dead(store, experiment.experiment_id, RUNS / "running")
    return store


def runs(status: str | None = None, **tags: str) -> list[Run]:
    """The runs of a status, or of any, with these tags, the newest first."""
    store = client()
    experiment = store.get_experiment_by_name(EXPERIMENT)
    assert experiment is not None
    conditions = [f"attributes.status = '{status}'"] if status else []
    conditions += [f"tags.{name} = '{value}'" for name, value in tags.items()]
    newest_first = ["attributes.start_time DESC"]
    return list(
        store.search_runs([experiment.experiment_id], " AND ".join(conditions), max_results=MOST, order_by=newest_first)
    )


def checkpoints(run_id: str) -> Path:
    """Where the state of a run's training is kept."""
    return RUNS / "checkpoints" / run_id


def whole() -> AbstractContextManager[None]:
    """Holds signals in the block: a write that one broke off would leave a transaction open, and the database locked.

    A server ends its transactions itself, and one that does not answer must not keep Ctrl-C waiting.
    """
    return nullcontext() if store_uri().startswith("http") else held()


def _check_reachable(uri: str) -> None:
    """Refuse at once what MLflow would try again and again, for minutes and with a warning each time.

    Raises:
        ConfigError: the local store cannot be opened, or nobody answers where a server should.
    """
    server = urlsplit(uri)
    try:
        if uri == local_uri() and (RUNS / "mlflow.db").exists():
            with closing(sqlite3.connect(RUNS / "mlflow.db")) as database:
                database.execute("PRAGMA schema_version")
        elif server.scheme in ("http", "https") and server.hostname:
            port = server.port or (443 if server.scheme == "https" else 80)
            socket.create_connection((server.hostname, port), timeout=10).close()
    except sqlite3.Error as error:
        raise ConfigError(f"{RUNS / 'mlflow.db'}: {error}, expected a store that MLflow can use") from None
    except (OSError, ValueError) as error:
        place = f"{server.scheme}://{server.netloc.rpartition('@')[2]}"  # without the password
        found = getattr(error, "strerror", None) or error
        raise ConfigError(f"MLFLOW_TRACKING_URI={place}: {found}, expected a server of MLflow that answers") from None


def _make_store() -> None:
    """A new SQLite file with all its tables, which has its name only when it is whole, however the process ends."""
    made = RUNS / "mlflow.db.new"
    for left in RUNS.glob(f"{made.name}*"):  # by one that was killed
        left.unlink()
    MlflowClient(f"sqlite:///{made.absolute()}").search_experiments(max_results=1)
    made.rename(RUNS / "mlflow.db")


def _create_experiment(store: MlflowClient, artifacts: str | None) -> None:
    try:
        store.create_experiment(EXPERIMENT, artifacts)
    except MlflowException:
        # A command on another machine, which the lock does not reach, may have been faster.
        if store.get_experiment_by_name(EXPERIMENT) is None:
            raise


def _relocate(old: str, new: str) -> None:
    """Follow a runs/ folder that was moved: MLflow keeps artifact locations absolute and cannot change them."""
    with closing(sqlite3.connect(RUNS / "mlflow.db")) as database, database:
        database.execute("UPDATE experiments SET artifact_location = ? WHERE artifact_location = ?", (new, old))
        database.execute(
            "UPDATE runs SET artifact_uri = ? || substr(artifact_uri, ?) WHERE artifact_uri LIKE ? || '/%'",
            (new, len(old) + 1, old),
        )


def find_run(wanted: str) -> Run:
    """The newest finished run that is meant by an id, NAME, PRESET/NAME or "latest".

    Raises:
        ConfigError: there is none.
    """
    finished = runs("FINISHED")
    for run in finished:
        if means(wanted, run):
            return run
    raise ConfigError(
        f"run={wanted}: no such finished run, {expected(wanted, finished)}"
        if finished
        else f"run={wanted}: no run has finished yet, expected one; try: make train"
    )


def means(wanted: str, run: Run) -> bool:
    """Whether a run may be meant by "latest", an id, NAME or PRESET/NAME."""
    return wanted in ("latest", run.info.run_id, *_names(run))


def expected(wanted: str, runs: Sequence[Run]) -> str:
    """How the runs there are can be named, with the name that is most like the wanted one."""
    known = sorted({name for run in runs for name in _names(run)})
    return f"expected latest, an id, NAME or PRESET/NAME{nearest(wanted, known)}"


def _names(run: Run) -> tuple[str, str]:
    return str(run.info.run_name), f"{run.data.tags.get('preset')}/{run.info.run_name}"


def artifact(run: Run, name: str) -> Path:
    """The local path of a run's artifact, fetched where the store is remote."""
    return Path(download_artifacts(run_id=run.info.run_id, artifact_path=name, tracking_uri=store_uri()))


class RunLogger(MLFlowLogger):
    """Lightning's MLflow logger, except that metrics are written in batches and the run's status is left alone.

    Args:
        store: where the run is.
        run_id: the run.
        again: what the store has of a step already is not written a second time. A run that goes on from a checkpoint
            repeats the steps after it, with the same results.
    """

    def __init__(self, store: MlflowClient, run_id: str, again: bool = False) -> None:
        super().__init__(EXPERIMENT, tracking_uri=store_uri(), run_id=run_id)
        self.store = store
        _ = self.experiment  # Lightning asks the store about it once: here, where no signal interrupts
        keys = store.get_run(run_id).data.metrics if again else ()
        self.written = {(key, point.step) for key in keys for point in store.get_metric_history(run_id, key)}
        self.buffer: list[Metric] = []
        self.flushed = time.monotonic()
        self.began: float | None = None

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
        """Write what is buffered, and up to when the run was at work."""
        with whole():
            for i in range(0, len(self.buffer), 1000):
                self.store.log_batch(str(self.run_id), metrics=self.buffer[i : i + 1000])
            if self.began is not None:
                self.store.set_tag(str(self.run_id), "seconds", f"{time.monotonic() - self.began:.3f}")
            self.buffer.clear()
            self.flushed = time.monotonic()

    def log_files(self, folder: str) -> None:
        """Make everything in a folder an artifact of the run."""
        with whole():
            self.store.log_artifacts(str(self.run_id), folder)

    def finalize(self, status: str = "success") -> None:
        self.save()


@contextmanager
def start(config: Config, data: DemonstrationData, resumed: Run | None = None) -> Iterator[RunLogger]:
    """A run `<ablation>-s<seed>` with its params, tags and data set, which ends with the status that is true.

    FINISHED when the block ends, KILLED when a signal interrupts it, FAILED when it raises. What not even gets to
    say so, a process killed or a machine without power, is marked by the next `client`.

    Args:
        config: the experiment.
        data: its demonstrations.
        resumed: the interrupted run to go on with, in place of a new one.

    Raises:
        ConfigError: another process goes on with it already.
    """
    store = client()
    logger: RunLogger | None = None
    status = "FINISHED"
    with alive.claim(RUNS / "running") as lock:
        try:
            # A signal between the store's commit and its answer would leave a run that nobody knows of to end.
            with held():
                run_id = _create(store, config, data, lock) if resumed is None else _reopen(store, resumed, lock)
                logger = RunLogger(store, run_id, again=resumed is not None)
                logger.count(at_work(resumed) if resumed else 0.0)
            with whole():
                _describe(store, run_id, config, data)
            yield logger
            signals.check()
        except BaseException:
            status = "KILLED" if signals.arrived() else "FAILED"
            raise
        finally:
            if logger is not None:
                _end(logger, status)


def _create(store: MlflowClient, config: Config, data: DemonstrationData, lock: dict[str, str]) -> str:
    experiment = store.get_experiment_by_name(EXPERIMENT)
    assert experiment is not None
    name = f"{config.ablation}-s{config.seed}"
    # With the run at once, not after it: by these tags it is found again, however early it is interrupted.
    tags = _tags(config, data) | lock
    return str(store.create_run(experiment.experiment_id, run_name=name, tags=tags).info.run_id)


def _reopen(store: MlflowClient, run: Run, lock: dict[str, str]) -> str:
    run_id = str(run.info.run_id)
    with FileLock(RUNS / ".store.lock"):
        if store.get_run(run_id).info.status == "RUNNING":
            raise ConfigError(f"resume={run.info.run_name}: expected an interrupted run, found one that is RUNNING")
        again = {"pid": str(os.getpid()), "resumed": str(int(run.data.tags.get("resumed", 0)) + 1)}
        for key, value in (lock | again | code.tags_after(run.data.tags)).items():
            store.set_tag(run_id, key, value)
        if run.data.tags.get(alive.NOTE) == alive.GONE:  # no longer true of it
            store.delete_tag(run_id, alive.NOTE)
        store.update_run(run_id, status="RUNNING")
    return run_id


def at_work(run: Run) -> float:
    """The seconds that a run was trained and evaluated, without those between an interruption and its resumption.

    Of a process that was killed what came after its last write is missing. A run of before this was counted says from
    when to when it was there.
    """
    if "seconds" in run.data.tags:
        return float(run.data.tags["seconds"])
    return float(run.info.end_time - run.info.start_time) / 1000


def _describe(store: MlflowClient, run_id: str, config: Config, data: DemonstrationData) -> None:
    store.log_batch(run_id, params=[Param(key, str(value)) for key, value in flatten(config.identity()).items()])
    store.log_dict(run_id, config.tree(), CONFIG_FILE)
    _log_dataset(store, run_id, data)


def _end(logger: RunLogger, status: str) -> None:
    run_id = str(logger.run_id)
    with whole():
        try:
            logger.save()
            logger.store.set_terminated(run_id, status)
            if status == "FINISHED":  # what such a run needs is among its artifacts
                shutil.rmtree(checkpoints(run_id), ignore_errors=True)
        except Exception:
            # What ended the run is what its user must hear of; a later command marks it.
            if status == "FINISHED":
                raise


def _tags(config: Config, data: DemonstrationData) -> dict[str, str]:
    return {
        "ablation": config.ablation,
        "preset": config.preset,
        "seed": str(config.seed),
        "config_sha": config.sha(),
        "data_digest": data.digest,
        "data_violating_share": f"{data.violates.float().mean():.4f}",
        **{f"data_{split}": str(len(getattr(data, split).x)) for split in ("train", "val", "test")},
        "pid": str(os.getpid()),
        "seconds": "0",
        **code.tags(),
        **origin(),
    }


def origin() -> dict[str, str]:
    """What is at work: this program's revision, its version and those of its libraries, the hardware."""
    # An installed package may lie in a repository that is not its own, such as its user's.
    ours = _git("ls-files", "--error-unmatch", Path(__file__).name) is not None
    sha, dirty = (_git("rev-parse", "HEAD"), _git("status", "--porcelain")) if ours else (None, None)
    versions = {"conflow": __version__} | {name: version(name) for name in ("torch", "lightning", "mlflow")}
    return {
        "git_sha": sha if sha is not None else "unknown",
        "git_dirty": str(bool(dirty)).lower() if dirty is not None else "unknown",
        "versions": ", ".join(f"{name} {number}" for name, number in versions.items()),
        "hardware": _hardware(),
        "threads": str(torch.get_num_threads()),
    }


def _hardware() -> str:
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


def _log_dataset(store: MlflowClient, run_id: str, data: DemonstrationData) -> None:
    name = Path(data.config.data.path).name if data.config.data.path else "generated swaps"
    dataset = from_numpy(data.x.numpy(), targets=data.violates.numpy(), name=name, digest=data.digest)
    inputs = [DatasetInput(dataset._to_mlflow_entity(), [InputTag("mlflow.data.context", "training")])]
    try:
        store.log_inputs(run_id, inputs)
    except MlflowException:
        # Of two runs that add the same new data set at once MLflow fails the slower one; by now the data set is there.
        store.log_inputs(run_id, inputs)
