"""Which runs are alive: each holds a lock, which tells its own machine at once, and beats in the store for all others.

A lock is released by the system when its process ends, however it ends. Of another machine's process only its beats are
known: when they have stopped for long enough it is taken for dead, and its run may be gone on with. It may live all the
same, behind a network that was cut. So a process makes sure before it writes that its run is still its own.
"""

import contextlib
import os
import platform
import signal
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout
from mlflow import MlflowClient
from mlflow.entities import Run

from conflow.errors import ConfigError

NOTE = "mlflow.note.content"
"""The tag that MLflow's pages show as a run's description."""
GONE = "The process ended without a word; a later command found it gone."
BEAT, EXPIRY = 60.0, 600.0
"""Seconds from one beat of a run to the next, and from a beat to when others may take the run for dead."""
ENGINE_TASK = "CONFLOW_ENGINE_TASK"
"""The environment's variable that names the task of an engine, such as Ray, that this process works for.

An engine tries a task again under the same name when its process or machine is gone.
"""
_held: set[str] = set()


class LostRunError(ConfigError):
    """A run that is no longer this process's to write to: another has taken it, or marked it as ended."""


class Claim:
    """A process's hold on a run.

    Args:
        lock: the file that it holds locked.
    """

    def __init__(self, lock: Path) -> None:
        self.lock = str(lock)
        self.store: MlflowClient | None = None
        self.run_id = ""
        self.until = time.time() + EXPIRY
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._beat_on, args=(os.getppid(),), daemon=True, name="beat")

    def tags(self) -> dict[str, str]:
        """Who has the run, and until when it counts as alive unless it beats again."""
        task = os.environ.get(ENGINE_TASK)
        held = {"host": platform.node(), "lock": self.lock, "alive_until": _seconds(self.until)}
        return held | ({"engine_task": task} if task else {})

    def keep(self, store: MlflowClient, run_id: str) -> None:
        """Beat for a run that has these tags, until the claim ends."""
        self.store, self.run_id = store, run_id
        self.thread.start()

    def check(self) -> None:
        """Make sure that the run is this process's, and will be for longer than a write takes to succeed or fail.

        Raises:
            LostRunError: it is not.
            MlflowException: the store does not say.
        """
        if time.time() < self.until - EXPIRY / 2:
            self._look()
        else:
            self._beat()

    def end(self) -> None:
        """Beat no more."""
        self.ended.set()
        if self.thread.is_alive():
            self.thread.join(timeout=10)

    def _look(self) -> None:
        assert self.store is not None
        run = self.store.get_run(self.run_id)
        name, host = run.info.run_name, run.data.tags.get("host")
        if run.data.tags.get("lock") != self.lock:
            raise LostRunError(f"run {name}: found that {host} goes on with it; this process ends and leaves it alone")
        if run.info.status != "RUNNING":
            raise LostRunError(
                f"run {name}: found it {run.info.status} by another's hand; this process ends and leaves it alone"
            )

    def _beat(self) -> None:
        assert self.store is not None
        self._look()
        until = time.time() + EXPIRY
        self.store.set_tag(self.run_id, "alive_until", _seconds(until))
        self.until = until

    def _beat_on(self, parent: int) -> None:
        beaten = time.monotonic()
        while not self.ended.wait(min(1.0, BEAT)):
            if ENGINE_TASK in os.environ and os.getppid() != parent:
                os.kill(os.getpid(), signal.SIGTERM)  # the engine's process is gone, and will try the task again
                return
            if time.monotonic() - beaten >= BEAT:
                beaten = time.monotonic()
                # What cannot be written is written the next time; that the run is lost its next write will say.
                with contextlib.suppress(Exception):
                    self._beat()


@contextmanager
def claim(folder: Path) -> Iterator[Claim]:
    """Hold a lock in a folder while the block runs."""
    folder.mkdir(parents=True, exist_ok=True)
    path = (folder / f"{uuid.uuid4().hex}.lock").absolute()
    held = Claim(path)
    _held.add(held.lock)
    try:
        with FileLock(path, thread_local=False):
            yield held
    finally:
        held.end()
        _held.discard(held.lock)
        path.unlink(missing_ok=True)


def is_alive(run: Run, folder: Path) -> bool:
    """Whether the process of a run that says RUNNING may be there still.

    Args:
        run: it may be of another machine, of which its last beat alone is known. One that never beat counts as alive.
        folder: where its lock may have been moved to.
    """
    tags = run.data.tags
    if tags.get("lock") in _held:
        return True
    task = os.environ.get(ENGINE_TASK)
    if task and tags.get("engine_task") == task:
        return False  # the engine runs one attempt of a task at a time: this was the one before
    beats = time.time() < float(tags.get("alive_until", "inf"))
    lock = Path(tags.get("lock", ""))
    if tags.get("host") != platform.node() or not lock.name:
        return beats
    if not lock.parent.is_dir():
        lock = folder / lock.name
        if not lock.exists():
            return beats
    if not lock.exists():
        return False
    try:
        with FileLock(lock, timeout=0):
            return False
    except Timeout:
        return True


def mark_dead(store: MlflowClient, experiment: str, folder: Path) -> None:
    """End, as KILLED, the runs of an experiment that say RUNNING and whose process is gone."""
    for found in store.search_runs([experiment], "attributes.status = 'RUNNING'"):
        if is_alive(found, folder):
            continue
        # One that has ended since the search let go of its lock as well, and one that was taken since has another.
        run = store.get_run(found.info.run_id)
        if run.info.status == "RUNNING" and not is_alive(run, folder):
            store.set_tag(run.info.run_id, NOTE, GONE)
            store.set_terminated(run.info.run_id, "KILLED")
            (folder / Path(run.data.tags["lock"]).name).unlink(missing_ok=True)


def _seconds(moment: float) -> str:
    return f"{moment:.0f}"
