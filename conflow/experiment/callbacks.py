"""What happens around the training loop: logging, progress, and evaluation under the three inference settings."""

import time
from collections.abc import Iterator
from statistics import median
from typing import Any

import torch
from lightning import Callback, Trainer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from conflow.experiment.build import random_stream
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.metrics import CollisionRate, trajectory_metrics
from conflow.experiment.module import SETTINGS, ConFlow, Setting

LATENCY_BATCH = 256
PLAIN_SECONDS = 10.0

Results = dict[Setting, dict[str, float]]


class TrainingLog(Callback):
    """train/loss, train/grad_norm and train/steps_per_second, every `log_every` steps.

    Between two points nothing is read from the device, so the loop never waits for a number.
    """

    def __init__(self, log_every: int) -> None:
        self.log_every = log_every
        self.since, self.loss = (0, 0.0), torch.zeros(())

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        self.since = trainer.global_step, time.monotonic()
        self.loss = torch.zeros((), device=pl_module.device)

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        self.loss += outputs["loss"]
        step, (last, then) = trainer.global_step, self.since
        if (step % self.log_every and step != trainer.max_steps) or trainer.logger is None:
            return
        now = time.monotonic()
        metrics = {
            "train/loss": float(self.loss) / (step - last),
            "train/grad_norm": float(pl_module.grad_norm),
            "train/steps_per_second": (step - last) / (now - then),
        }
        trainer.logger.log_metrics(metrics, step)
        self.loss.zero_()
        self.since = step, now


class ProgressDisplay:
    """How far a long piece of work is and how long it still takes: a bar on a terminal, else a line now and then."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.bars = Progress(
            TextColumn("{task.description:<18}"),
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self.printed = 0.0

    def add(self, name: str, total: int) -> TaskID:
        self.bars.start()
        self.printed = time.monotonic()
        return self.bars.add_task(name, total=total, note="")

    def update(self, task: TaskID, completed: int, note: str = "") -> None:
        self.bars.update(task, completed=completed, note=note)
        state = self.bars.tasks[task]
        now = time.monotonic()
        if self.console.is_terminal or (now - self.printed < PLAIN_SECONDS and not state.finished):
            return
        self.printed = now
        left = "done" if state.finished else f"{state.time_remaining or 0:.0f} s left"
        self.console.print(f"{state.description} {completed}/{state.total:.0f}  {note}  {left}", highlight=False)

    def stop(self) -> None:
        self.bars.stop()


class TrainingProgress(Callback):
    """Shows the steps, the last loss and the remaining time of training."""

    def __init__(self, display: ProgressDisplay) -> None:
        self.display = display
        self.task = TaskID(0)
        self.note = ""
        self.updated = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        self.task = self.display.add("training", trainer.max_steps)

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        now = time.monotonic()
        if now - self.updated > 0.5 or trainer.global_step == trainer.max_steps:
            self.updated = now
            self.display.update(self.task, trainer.global_step, f"loss {float(outputs['loss']):.4f}")

    def on_exception(self, trainer: Trainer, pl_module: Any, exception: BaseException) -> None:
        self.display.stop()


class Evaluate(Callback):
    """Samples under the three settings when training ends, and a small sample at every validation.

    Each of the `sample.num` samples gets the start and goal of a test trajectory (of a validation trajectory
    during training), the first again after the last. The noise depends on seed and setting alone.

    Attributes:
        results: the metrics of each setting, complete when training has ended.
        samples: the trajectories of each setting, (num, T, D).
        source_samples: trajectories x_0 of the source for the same starts and goals, (num, T, D).
    """

    def __init__(self, data: DemonstrationData, display: ProgressDisplay) -> None:
        self.data, self.display = data, display
        self.results: Results = {}
        self.samples: dict[Setting, Tensor] = {}
        self.source_samples = torch.empty(0)

    def on_validation_end(self, trainer: Trainer, pl_module: Any) -> None:
        if trainer.logger is None or trainer.sanity_checking:
            return
        model: ConFlow = pl_module
        x_1 = _cycle(self.data.val.x, min(LATENCY_BATCH, model.config.sample.num)).to(model.device)
        x = model.sample(model.source.observe(x_1), "none", self._noise(model, "validation samples", "none"))
        rate = CollisionRate("robot_collision", model.robots).to(model.device)
        rate.update(x)
        # val/loss goes along: Lightning would log it at the step before.
        metrics = {f"val/none/{name}": value for name, value in rate.compute().items()}
        metrics["val/loss"] = float(trainer.callback_metrics["val/loss"])
        trainer.logger.log_metrics(metrics, trainer.global_step)

    def on_train_end(self, trainer: Trainer, pl_module: Any) -> None:
        model: ConFlow = pl_module
        model.eval()
        with torch.inference_mode():
            task = self.display.add("sampling", len(SETTINGS))
            for done, (setting, metrics) in enumerate(self._settings(model), start=1):
                self.results[setting] = metrics
                self.display.update(task, done, f"setting {setting}")
                if trainer.logger is not None:
                    keyed = {f"test/{setting}/{name}": value for name, value in metrics.items()}
                    trainer.logger.log_metrics(keyed, trainer.global_step)
        self.display.stop()

    def _settings(self, model: ConFlow) -> Iterator[tuple[Setting, dict[str, float]]]:
        x_1 = _cycle(self.data.test.x, model.config.sample.num).to(model.device)
        y = model.source.observe(x_1)
        self.source_samples = model.source.sample(y, self._noise(model, "test samples", "none")).cpu()
        for setting in SETTINGS:
            x = model.sample(y, setting, self._noise(model, "test samples", setting))
            metrics = trajectory_metrics(model.robots, model.obstacle).to(model.device)
            metrics.update(x=x, x_1=x_1)
            self.samples[setting] = x.cpu()
            yield setting, metrics.compute() | {"num": len(x), "latency_ms": _latency_ms(model, y, setting)}

    def _noise(self, model: ConFlow, purpose: str, setting: Setting) -> torch.Generator:
        return random_stream(purpose, model.config.seed, setting, device=model.device)


def _cycle(x: Tensor, num: int) -> Tensor:
    """The first `num` rows of x, beginning again where there are fewer."""
    return x[torch.arange(num) % len(x)]


def _latency_ms(model: ConFlow, y: Tensor, setting: Setting, repetitions: int = 3) -> float:
    """Median time of sampling one batch of 256, in milliseconds."""
    y = _cycle(y, LATENCY_BATCH)
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        model.sample(y, setting).cpu()  # to the host, so that an accelerator has finished
        times.append(1000 * (time.perf_counter() - start))
    return median(times)
