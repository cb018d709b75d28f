"""Every ablation for every seed: which cells are finished, which are to do, and a process for each that is."""

import contextlib
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from rich.console import Console

from conflow.scene.errors import DemonstrationError
from conflow.tracking import code, resume, signals, store
from conflow.training import config, progress
from conflow.training.config import Config
from conflow.training.datamodule import DemonstrationData
from conflow.training.progress import ProgressDisplay

STAGES = {"training": (0.0, 0.9), "sampling test": (0.9, 0.05), "sampling validation": (0.95, 0.05)}
"""What comes before each stage of a cell, and what it adds, as shares of the whole."""


@dataclass
class Job:
    """One experiment of the grid: the arguments that ask for it, how far it is, and whether it failed to end well.

    Attributes:
        resume: the arguments by which it goes on where it was interrupted.
        again: why it is trained although it was before.
        progress: the file in which its process says how far it is.
    """

    arguments: list[str]
    config: Config
    share: float = 0.0
    note: str = ""
    resume: list[str] = field(default_factory=list)
    again: str = ""
    failed: bool = True
    output: list[str] = field(default_factory=list)
    progress: Path | None = None

    @property
    def name(self) -> str:
        return self.config.name

    @cached_property
    def digest(self) -> str:
        """Of its demonstrations; none where they cannot be used, which the cell itself will say: the others go on."""
        try:
            return DemonstrationData(self.config, training=False).digest
        except DemonstrationError:
            return ""

    def look(self, found: tuple[str, float, float] | None) -> None:
        """Take its progress from what its process says: the stage, how much of it is done, and how much there is."""
        if found:
            stage, completed, total = found
            before, share = STAGES.get(stage, (self.share, 0.0))
            self.share, self.note = before + share * completed / total, f"{stage} {completed:g}/{total:g}"


def run(
    ablations: Sequence[str],
    seeds: Sequence[str],
    arguments: Sequence[str],
    jobs: int,
    console: Console,
    any_code: bool = False,
) -> int:
    """Train the cells that are not finished yet, `jobs` at a time; the number of cells that failed.

    A cell is finished when MLflow has a FINISHED run of the same config on the same data by the same code, so a grid
    that was stopped goes on where it stopped. One that another process trains is left to that. Each cell is a process
    of its own: one that fails leaves the others alone.

    Args:
        ablations: by name.
        seeds: each for every ablation.
        arguments: further settings of all cells.
        jobs: how many are trained at once.
        console: for progress.
        any_code: take runs of other code as well.

    Raises:
        ConfigError: any of the cells cannot be asked for; then none is started.
    """
    every = cells(ablations, seeds, arguments)
    todo = [cell for cell in every if not finished(cell, any_code)]
    console.print(f"{len(every)} cells, {len(every) - len(todo)} of them finished before", highlight=False)
    for cell in todo:
        if cell.again:
            console.print(f"{cell.name}: {cell.again}", highlight=False, soft_wrap=True)
    if todo:
        _train_all(todo, jobs, console, any_code)
    return failures(todo, console)


def cells(ablations: Sequence[str], seeds: Sequence[str], arguments: Sequence[str]) -> list[Job]:
    """Every ablation for every seed, the same experiment once.

    Raises:
        ConfigError: any of them cannot be asked for.
    """
    found: dict[str, Job] = {}
    for seed in seeds:
        for ablation in ablations:
            chosen = [f"ablation={ablation}", f"seed={seed}", *arguments]
            cell = Job(chosen, config.load(chosen))
            found.setdefault(cell.config.sha(), cell)
    return list(found.values())


def failures(cells: Sequence[Job], console: Console) -> int:
    """Say of each cell that failed why; their number."""
    for cell in cells:
        if cell.failed:
            console.print(
                f"{cell.name} failed: {cell.output[-1] if cell.output else 'no output'}",
                highlight=False,
                soft_wrap=True,
            )
    return sum(cell.failed for cell in cells)


def overview(cells: Sequence[Job]) -> tuple[float, str]:
    """How many cells are done, in tenths, and what those at work do."""
    busy = " ".join(f"{cell.name} {cell.note}" for cell in cells if cell.note)
    return math.floor(10 * sum(cell.share for cell in cells)) / 10, busy


def finished(cell: Job, any_code: bool) -> bool:
    """Whether a cell is; if it was interrupted, it is told to go on from there, and if by other code, why it is not."""
    cell.resume, cell.again = [], ""
    if not cell.digest:
        return False
    runs = store.runs(config_sha=cell.config.sha(), data_digest=cell.digest)
    ended = [run for run in runs if run.info.status in ("FINISHED", *resume.INTERRUPTED)]
    ours = [run for run in ended if any_code or not code.differing(run.data.tags)]
    if any(run.info.status == "FINISHED" for run in ours):
        return True
    if ours:
        cell.resume = [f"resume={ours[0].info.run_id}", *(["code=any"] if any_code else [])]
    elif ended:
        cell.again = f"trained by other code: {', '.join(code.differing(ended[0].data.tags))}"
    return False


def elsewhere(cell: Job, any_code: bool) -> str:
    """The machine where another process trains a cell now, or did until it fell silent less than ten minutes ago."""
    if not cell.digest:
        return ""
    for run in store.runs("RUNNING", config_sha=cell.config.sha(), data_digest=cell.digest):
        if "alive_until" in run.data.tags and (any_code or not code.differing(run.data.tags)):
            return str(run.data.tags["host"])
    return ""


def _train_all(cells: Sequence[Job], jobs: int, console: Console, any_code: bool = False) -> None:
    waiting, threads = list(cells), list[threading.Thread]()
    processes: set[subprocess.Popen[str]] = set()
    with ProgressDisplay(console) as display, tempfile.TemporaryDirectory() as folder:
        for i, cell in enumerate(cells):
            cell.progress = Path(folder, str(i))
        task = display.add("cells", len(cells))
        try:
            while waiting or any(thread.is_alive() for thread in threads):
                while waiting and sum(thread.is_alive() for thread in threads) < jobs:
                    cell = waiting.pop(0)
                    if not _settled(cell, any_code, console):
                        threads.append(threading.Thread(target=_train, args=(cell, processes, jobs), daemon=True))
                        threads[-1].start()
                time.sleep(0.5)
                for cell in cells:
                    cell.look(progress.read(cell.progress) if cell.progress else None)
                display.update(task, *overview(cells))
        except BaseException:
            with signals.held():
                _stop(processes, threads)
            raise


def _settled(cell: Job, any_code: bool, console: Console) -> bool:
    """Whether another process trains a cell that is about to begin, or has finished it since the grid began."""
    host = ""
    with contextlib.suppress(Exception):  # what is wrong with the store the cell's own process will say
        host = elsewhere(cell, any_code)
        cell.failed = not (host or finished(cell, any_code))
    if host:
        console.print(f"{cell.name}: another process trains it, on {host}", highlight=False, soft_wrap=True)
    elif not cell.failed:
        cell.share = 1.0
    return not cell.failed


def _stop(processes: set[subprocess.Popen[str]], threads: Sequence[threading.Thread]) -> None:
    """End the cells that train: each marks its own run KILLED."""
    told: set[subprocess.Popen[str]] = set()
    while any(thread.is_alive() for thread in threads):
        for process in set(processes) - told:  # also one that was only being started
            process.terminate()
            told.add(process)
        time.sleep(0.1)


def _train(cell: Job, processes: set[subprocess.Popen[str]], jobs: int) -> None:
    """Train a cell in a process of its own, to its end."""
    said = {progress.FILE: str(cell.progress)} if cell.progress else {}
    process = subprocess.Popen(
        [sys.executable, "-m", "conflow", "train", *cell.arguments, *cell.resume],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        # Processes that share the cores would otherwise each start a thread for every core and crawl.
        env={"OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // jobs)), **os.environ, **said},
        start_new_session=True,  # Ctrl-C reaches the grid alone, which then ends its cells in order
    )
    processes.add(process)
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip():
            cell.output.append(line.strip())
    cell.failed = process.wait() != 0
    processes.discard(process)
    cell.share, cell.note, cell.progress = 1.0, "", None
