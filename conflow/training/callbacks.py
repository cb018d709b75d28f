"""What happens around the training loop: logging, progress, and a small sample at validation."""

import signal
import time
from typing import Any

import torch
from lightning import Callback, Trainer
from rich.progress import TaskID
from torchmetrics import MetricCollection

from conflow.tracking import ranks
from conflow.training.build import random_stream
from conflow.training.datamodule import DemonstrationData
from conflow.training.evaluation import cycle
from conflow.training.metrics import CollisionRate
from conflow.training.model import ConFlow
from conflow.training.progress import ProgressDisplay

VALIDATION_SAMPLES = 256


class OwnSignals(Callback):
    """Leaves SIGTERM to this program where there are several processes.

    Lightning's handler would first tell it to the others, and wait for ever where one of them waits for this one.
    """

    def on_fit_start(self, trainer: Trainer, pl_module: Any) -> None:
        self.own = signal.getsignal(signal.SIGTERM)

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        signal.signal(signal.SIGTERM, self.own)


class TrainingLog(Callback):
    """train/loss, train/grad_norm, train/steps_per_second and train/seconds, every `log_every` steps.

    Between two points nothing is read from the device, so the loop never waits for a number. What every process has
    summed up since the last one is part of a checkpoint. The seconds are those of training alone: during a validation
    and the checkpoint after it the clock stands still.
    """

    def __init__(self, log_every: int) -> None:
        self.log_every = log_every
        self.summed, self.loss = 0, torch.zeros(())
        self.since = 0, 0.0
        self.seconds = 0.0
        self.ticking: float | None = None

    def state_dict(self) -> dict[str, Any]:
        losses = torch.stack(ranks.each(self.loss.cpu()))
        return {"summed": self.summed, "loss": losses, "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.summed, self.seconds = state_dict["summed"], state_dict["seconds"]
        losses = state_dict["loss"].reshape(-1)  # one number in a checkpoint from before there were several processes
        self.loss = losses[ranks.rank()].clone() if len(losses) == ranks.world() else losses.mean()

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        self.since = trainer.global_step, self.seconds
        self.loss = self.loss.to(pl_module.device)
        self._tick()

    def on_train_batch_start(self, trainer: Trainer, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if self.ticking is None:
            self._tick()

    def on_validation_start(self, trainer: Trainer, pl_module: Any) -> None:
        self._tick()
        self.ticking = None

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        self.loss += outputs["loss"]
        self.summed += 1
        step, (last, then) = trainer.global_step, self.since
        if step % self.log_every and step != trainer.max_steps:
            return
        loss = ranks.mean(self.loss)
        pl_module.check_finite("the loss", loss, batch_idx)
        self._tick()
        metrics = {
            "train/loss": float(loss) / self.summed,
            "train/grad_norm": float(pl_module.grad_norm),
            "train/steps_per_second": (step - last) / (self.seconds - then),
            "train/seconds": self.seconds,
        }
        if trainer.logger is not None:
            trainer.logger.log_metrics(metrics, step)
        self.loss.zero_()
        self.summed, self.since = 0, (step, self.seconds)

    def _tick(self) -> None:
        """Add what has passed since the last tick."""
        now = time.monotonic()
        self.seconds += 0.0 if self.ticking is None else now - self.ticking
        self.ticking = now


class TrainingProgress(Callback):
    """Shows the steps, the last loss and the remaining time of training."""

    def __init__(self, display: ProgressDisplay) -> None:
        self.display = display
        self.task = TaskID(0)
        self.updated = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        self.task = self.display.add("training", trainer.max_steps)

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        now = time.monotonic()
        if now - self.updated > 0.5 or trainer.global_step == trainer.max_steps:
            self.updated = now
            self.display.update(self.task, trainer.global_step, f"loss {float(outputs['loss']):.4f}")


class ValidationSamples(Callback):
    """Takes a small sample at every validation: the curves val/none/CONSTRAINT_collision_rate beside val/loss.

    Of the trained model there is more under validation/: every setting and metric, and as many samples as of test.
    """

    def __init__(self, data: DemonstrationData) -> None:
        self.data = data

    def on_validation_end(self, trainer: Trainer, pl_module: Any) -> None:
        if trainer.logger is None:
            return
        model: ConFlow = pl_module
        x_1 = cycle(self.data.val.x, min(VALIDATION_SAMPLES, model.config.sample.num)).to(model.device)
        noise = random_stream("validation samples", model.config.seed, device=model.device)
        named = {name: CollisionRate(f"{name}_collision", model.judged[name]) for name in model.task.constraints()}
        rates = MetricCollection(dict(named), compute_groups=False).to(model.device)
        rates.update(model.sample(x_1, "none", noise))
        metrics = {f"val/none/{name}": value for name, value in rates.compute().items()}
        # val/loss goes along: Lightning would log it at the step before.
        metrics["val/loss"] = float(trainer.callback_metrics["val/loss"])
        trainer.logger.log_metrics(metrics, trainer.global_step)
