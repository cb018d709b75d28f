"""How far a long piece of work is and how long it still takes: a bar on a terminal, else a line now and then."""

import os
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from conflow.tracking import signals

PLAIN_SECONDS = 10.0
FILE = "CONFLOW_PROGRESS"
"""The environment's variable that names a file in which a process says how far it is, for who started it."""
FILE_SECONDS = 0.5


def read(path: Path) -> tuple[str, float, float] | None:
    """The task, how much of it is done and how much there is, of the process that writes this file; None at first."""
    try:
        name, completed, total = path.read_text().split("\t")
    except (OSError, ValueError):  # not there yet, or being written
        return None
    return name, float(completed), float(total)


class ProgressDisplay:
    """Progress of one or more tasks on a console; use as a context manager."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.bars = Progress(
            TextColumn("{task.description:<18}"),
            BarColumn(),
            TextColumn("{task.completed:g}/{task.total:g}"),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self.printed = self.written = 0.0
        self.file = os.environ.get(FILE)

    def __enter__(self) -> "ProgressDisplay":
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()

    def add(self, name: str, total: int) -> TaskID:
        """A new task of so many steps."""
        self.printed = time.monotonic()
        return self.bars.add_task(name, total=total, note="")

    def update(self, task: TaskID, completed: float, note: str = "") -> None:
        """So many steps are done; the note stands beside them.

        Raises:
            Interrupted: a signal asked this process to end, and was dropped where it was raised.
        """
        signals.check()
        state = self.bars.tasks[task]
        if state.finished:
            return
        self.bars.update(task, completed=completed, note=note)
        now = time.monotonic()
        if self.file and (now - self.written > FILE_SECONDS or state.finished):
            self.written = now
            Path(self.file).write_text(f"{state.description}\t{completed:g}\t{state.total:g}")
        if self.console.is_terminal or (now - self.printed < PLAIN_SECONDS and not state.finished):
            return
        self.printed = now
        remaining = "" if state.time_remaining is None else f"{state.time_remaining:.0f} s left"
        parts = [f"{state.description} {completed:g}/{state.total:g}", note, "done" if state.finished else remaining]
        self.console.print("  ".join(part for part in parts if part), highlight=False)
