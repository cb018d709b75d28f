"""Commands in processes of their own that really die at a chosen moment, and what they leave in the store.

The processes are forked from a server that has imported everything once, so each costs a second or two instead of ten.
"""

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from mlflow import MlflowClient
from mlflow.entities import Run

from conflow.tracking.signals import SIGNALS

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["conflow.training.train", "conflow.grid.local", "tests.faults.processes"])

Death = Callable[[], None]
"""Arranges, within the process, how it is going to die."""


def start(folder: Path, *arguments: str, death: Death | None = None) -> Any:
    """A process that runs the command line in a folder, its output in the file `output` there."""
    process = CONTEXT.Process(target=_main, args=(folder, arguments, death), daemon=True)  # ends with a test that fails
    process.start()
    return process


def run(folder: Path, *arguments: str, death: Death | None = None, seconds: float = 180) -> tuple[int, str]:
    """Exit code of a command, negative for a signal that killed it, and what it printed."""
    process = start(folder, *arguments, death=death)
    process.join(seconds)
    if process.is_alive():
        process.kill()
        process.join()
        raise TimeoutError(f"{arguments} still ran after {seconds} s; {(folder / 'output').read_text()}")
    return process.exitcode, (folder / "output").read_text()


def _main(folder: Path, arguments: tuple[str, ...], death: Death | None) -> None:
    from conflow.__main__ import main

    for signum in SIGNALS:
        signal.signal(signum, signal.default_int_handler)  # whatever the tests' own process ignores
    os.chdir(folder)
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    output = os.open("output", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    torch.set_num_threads(1)
    if death is not None:
        death()
    sys.argv = ["conflow", *arguments]
    main()


def killed_in(module: str, name: str, call: int = 1, signum: signal.Signals = signal.SIGKILL) -> Death:
    """A signal at the given call of a function, before it does anything."""
    return _Kill(module, name, call, signum)


class _Kill:
    """Replaces module.name by a function that kills its process; a class, so that it can be sent to a process."""

    def __init__(self, module: str, name: str, call: int, signum: signal.Signals) -> None:
        self.module, self.name, self.call, self.signum = module, name, call, signum

    def __call__(self) -> None:
        import importlib

        *path, name = self.name.split(".")
        owner: Any = importlib.import_module(self.module)
        for part in path:
            owner = getattr(owner, part)
        original = getattr(owner, name)

        def fatal(*positional: Any, **named: Any) -> Any:
            self.call -= 1
            if self.call == 0:
                os.kill(os.getpid(), self.signum)
            return original(*positional, **named)

        setattr(owner, name, fatal)


def store(folder: Path) -> MlflowClient:
    return MlflowClient(f"sqlite:///{folder / 'runs' / 'mlflow.db'}")


def runs(folder: Path) -> list[Run]:
    """All runs, the newest first; none while the store is being made."""
    client = store(folder)
    experiment = client.get_experiment_by_name("conflow")
    if experiment is None:
        return []
    return list(client.search_runs([experiment.experiment_id], order_by=["attributes.start_time DESC"]))


def wait_for_metrics(folder: Path, name: str) -> None:
    """Until a run has written what it measured of a step."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if any(run.info.run_name == name and "train/loss" in run.data.metrics for run in runs(folder)):
            return
        time.sleep(0.3)
    raise TimeoutError(f"{name}: {(folder / 'output').read_text() if (folder / 'output').exists() else ''}")


def weights(run: Run) -> dict[str, torch.Tensor]:
    """The tensors of a run's model."""
    path = Path(str(run.info.artifact_uri).removeprefix("file://"), "model.ckpt")
    state: dict[str, torch.Tensor] = torch.load(path, weights_only=True)["state_dict"]
    return state


def history(folder: Path, run: Run) -> dict[str, list[tuple[int, float]]]:
    """Every metric's steps and values, but for those that are times."""
    return {
        key: sorted((point.step, point.value) for point in store(folder).get_metric_history(run.info.run_id, key))
        for key in run.data.metrics
        if not key.endswith(("steps_per_second", "train/seconds", "latency_ms"))
    }


def checkpoint_folder(folder: Path, run: Run) -> Path:
    return folder / "runs" / "checkpoints" / str(run.info.run_id)
