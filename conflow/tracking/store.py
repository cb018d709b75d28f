"""MLflow's store: where it is, how it is made, and which runs are in it."""

import logging
import os
import re
import socket
import sqlite3
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from urllib.parse import urlsplit

from filelock import FileLock
from mlflow import MlflowClient
from mlflow.artifacts import download_artifacts
from mlflow.entities import Run
from mlflow.exceptions import MlflowException

from conflow.errors import ConfigError, nearest
from conflow.tracking import liveness
from conflow.tracking.signals import held

# MLflow tells every user about every table of a new store,
logging.getLogger("mlflow.store.db.utils").setLevel(logging.WARNING)
# and shows a bar for every file that it copies.
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
# Nor need it print a run's address on a server when the run ends, after what the command itself says last.
os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
# A write to a server that cannot be reached fails after four minutes, while the run is still its process's for certain.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "30")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "5")

EXPERIMENT = "conflow"
MOST = 50_000
"""Runs that a search may return: as many as MLflow allows."""
RUNS = Path("runs")


def local_uri() -> str:
    """The SQLite file under runs/."""
    return f"sqlite:///{(RUNS / 'mlflow.db').absolute()}"


def store_uri() -> str:
    """MLFLOW_TRACKING_URI, or the SQLite file under runs/."""
    return os.environ.get("MLFLOW_TRACKING_URI") or local_uri()


def place() -> str:
    """The store, as messages name it: its address without a password, or the file."""
    uri = store_uri()
    return str(RUNS / "mlflow.db") if uri == local_uri() else re.sub(r"(?<=//)[^/@\s]+@", "", uri)


def exists() -> bool:
    """Whether there is a store, of which to ask something: a question does not make one.

    What stands in its place and cannot be used counts too: asking it says why.
    """
    blocked = RUNS.exists() and not RUNS.is_dir()
    return store_uri() != local_uri() or (RUNS / "mlflow.db").exists() or blocked


def client() -> MlflowClient:
    """A client of the store, which is made together with the experiment where it is missing.

    Runs whose process is gone are marked on the way, so that from here on none says RUNNING that is dead.
    """
    RUNS.mkdir(parents=True, exist_ok=True)
    check_reachable()
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
        liveness.mark_dead(store, experiment.experiment_id, RUNS / "running")
    return store


def runs(status: str | None = None, **tags: str) -> list[Run]:
    """The runs of a status, or of any, with these tags, the newest first."""
    if not exists():
        return []
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


def check_reachable() -> None:
    """Refuse at once what MLflow would try again and again, for minutes and with a warning each time.

    Raises:
        ConfigError: the local store cannot be opened, or nobody answers where a server should.
    """
    uri = store_uri()
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
        else f"run={wanted}: no run has finished yet in {place()}, expected one; try: make train"
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
