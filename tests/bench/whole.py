"""Where the time of a whole run goes: training, sampling, metrics, logging, pictures."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from lightning import Trainer
from mlflow import MlflowClient
from rich.console import Console

from conflow.figures import workspace
from conflow.tracking import recording
from conflow.tracking.checkpoints import Checkpoints
from conflow.training import config, evaluation
from conflow.training.callbacks import ValidationSamples
from conflow.training.module import Training
from conflow.training.train import train
from tests.bench.clock import Row, Target, compared

SECTIONS: dict[str, list[tuple[Any, str]]] = {
    "metrics": [(evaluation, "measure"), (evaluation, "_mixture_distance")],
    "logging": [
        *((recording, name) for name in ("client", "_create", "_describe", "_end")),
        *((recording.RunLogger, name) for name in ("log_metrics", "save")),
        (MlflowClient, "log_artifacts"),
    ],
    "pictures": [(workspace, "of_training")],
    "checkpoints": [(Checkpoints, "_save")],
    "validation": [(Training, "validation_step"), (ValidationSamples, "on_validation_end")],
    "sampling": [(Training, "flow")],
    "latencies": [(evaluation, "_latency_ms")],
}
"""What each of them consists of; of one that is called within another, the outer one has the time."""
BOTH, LITTLE = "metrics and logging", Target(0.02)
SHORTER = 10
"""A run that is so many times shorter, with as many times fewer validations, stands for one of the preset."""


def rows(preset: str = "quick") -> list[Row]:
    """Shares of a run of a preset."""
    whole = config.load([f"preset={preset}"]).train
    steps = whole.max_steps // SHORTER
    interval = min(whole.val_every, steps)
    settings = config.load([f"preset={preset}", f"train.max_steps={steps}", f"train.val_every={interval}"])
    start, tally = time.perf_counter(), Tally()
    with tally.taken():
        train(settings, Console(quiet=True), draw=lambda *content: workspace.of_training(*content))
    total = time.perf_counter() - start + (SHORTER - 1) * tally.fitting / SHORTER
    seconds = {**tally.seconds, BOTH: tally.seconds["metrics"] + tally.seconds["logging"]}
    part = f"a run of preset {preset}, of which one {SHORTER} times shorter was timed"
    return [
        compared(part, name, "the run", [one], [total], "share", LITTLE if name == BOTH else None)
        for name, one in seconds.items()
    ]


class Tally:
    """Seconds of each section while it is `taken`; those of the training loop count as often as it was cut short."""

    def __init__(self) -> None:
        self.seconds = {"training": 0.0} | dict.fromkeys(SECTIONS, 0.0)
        self.fitting, self.scale, self.busy = 0.0, 1, False

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Time everything that is called within the block."""
        with ExitStack() as stack:
            for section, functions in SECTIONS.items():
                for owner, name in functions:
                    stack.enter_context(patch.object(owner, name, self._timed(section, getattr(owner, name))))
            stack.enter_context(patch.object(Trainer, "fit", self._fit(Trainer.fit)))
            yield

    def _timed(self, section: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            if self.busy:
                return function(*args, **kwargs)
            self.busy, start = True, time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.busy = False
                self.seconds[section] += self.scale * (time.perf_counter() - start)

        return timed

    def _fit(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def fit(*args: Any, **kwargs: Any) -> None:
            before, start = sum(self.seconds.values()), time.perf_counter()
            self.scale = SHORTER
            function(*args, **kwargs)
            self.scale = 1
            self.fitting = SHORTER * (time.perf_counter() - start)
            self.seconds["training"] = self.fitting - (sum(self.seconds.values()) - before)

        return fit
