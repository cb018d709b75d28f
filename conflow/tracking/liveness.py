"""Which runs are alive: each holds a lock that the system releases when its process ends, however it ends."""

import platform
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout
from mlflow import MlflowClient
from mlflow.entities import Run

NOTE = "mlflow.note.content"
"""The tag that MLflow's pages show as a run's description."""
GONE = "The process ended without a word; a later command found it gone."


@contextmanager
def claim(folder: Path) -> Iterator[dict[str, str]]:
    """Hold a lock in a folder while the block runs; the tags by which `is_alive` finds it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = (folder / f"{uuid.uuid4().hex}.lock").absolute()
    try:
        with FileLock(path, thread_local=False):
            yield {"host": platform.node(), "lock": str(path)}
    finally:
        path.unlink(missing_ok=True)


def is_alive(run: Run, folder: Path) -> bool:
    """Whether the process of a run that says RUNNING may be there still.

    Args:
        run: it may be of another machine, of which nothing can be known: then it counts as alive.
        folder: where its lock may have been moved to.
    """
    lock = Path(run.data.tags.get("lock", ""))
    if run.data.tags.get("host") != platform.node() or not lock.name:
        return True
    if not lock.parent.is_dir():
        lock = folder / lock.name
        if not lock.exists():
            return True
    if not lock.exists():
        return False
    try:
        with FileLock(lock, timeout=0):
            return False
    except Timeout:
        return True


def mark_dead(store: MlflowClient, experiment: str, folder: Path) -> None:
    """End, as KILLED, the runs of an experiment that say RUNNING and whose process is gone."""
    for run in store.search_runs([experiment], "attributes.status = 'RUNNING'"):
        # A run that has ended since the search let go of its lock as well, but says so.
        if not is_alive(run, folder) and store.get_run(run.info.run_id).info.status == "RUNNING":
            store.set_tag(run.info.run_id, NOTE, GONE)
            store.set_terminated(run.info.run_id, "KILLED")
            (folder / Path(run.data.tags["lock"]).name).unlink(missing_ok=True)
