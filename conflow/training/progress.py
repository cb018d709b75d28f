"""How far a long piece of work is and how long it still takes: a bar on a terminal, else a line now and then."""

import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from conflow.tracking import signals

PLAIN_SECONDS = 10.0


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
        self.printed = 0.0

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
        if self.console.is_terminal or (now - self.printed < PLAIN_SECONDS and not state.finished):
            return
        self.printed = now
        remaining = "" if state.time_remaining is None else f"{state.time_remaining:.0f} s left"
        parts = [f"{state.description} {completed:g}/{state.total:g}", note, "done" if state.finished else remaining]
        self.console.print("  ".join(part for part in parts if part), highlight=False)
