"""A run's last checkpoint among its artifacts, for the machine that goes on with it where runs/ is not shared."""

import contextlib
import os
import tempfile
from pathlib import Path

from mlflow import MlflowClient
from mlflow.entities import Run
from mlflow.exceptions import MlflowException
from mlflow.store.artifact.artifact_repository_registry import get_artifact_repository

from conflow.tracking import checkpoints, store
from conflow.tracking.checkpoint_file import write

ASKED = "CONFLOW_CARRY"
"""The environment's variable that asks for it."""
SECONDS = 60.0
"""The least time between two uploads."""
FOLDER = "checkpoint"


def asked() -> bool:
    """Whether this process's checkpoints are to be carried."""
    return ASKED in os.environ


def put(client: MlflowClient, run_id: str, path: Path, count: int) -> None:
    """Make a checkpoint an artifact, in one of two places in turn: what breaks off an upload may leave a part of it."""
    client.log_artifact(run_id, str(path), f"{FOLDER}/{count % 2}")


def fetch(run: Run) -> None:
    """Bring the newest carried checkpoint of a run to where its checkpoints are kept, if it is newer than those."""
    client, run_id = MlflowClient(store.store_uri()), str(run.info.run_id)
    folder = store.checkpoints(run_id)
    with tempfile.TemporaryDirectory() as temporary:
        for place in client.list_artifacts(run_id, FOLDER):
            with contextlib.suppress(MlflowException):  # one that cannot be had is as good as none
                client.download_artifacts(run_id, place.path, temporary)
        found = [checkpoints.newest(path.parent) for path in Path(temporary).rglob(checkpoints.LAST)]
        path, step, _ = max(found, key=lambda one: one[1], default=(None, 0, []))
        if path is not None and step > checkpoints.newest(folder)[1]:
            write(folder / checkpoints.LAST, path.read_bytes(), folder / checkpoints.PREVIOUS)


def remove(client: MlflowClient, run_id: str) -> None:
    """Drop what was carried of a run that has finished."""
    if client.list_artifacts(run_id, FOLDER):
        uri = str(client.get_run(run_id).info.artifact_uri)
        get_artifact_repository(uri, tracking_uri=store.store_uri()).delete_artifacts(FOLDER)  # type: ignore[no-untyped-call]
