"""What happens around the training loop: logging, progress, and evaluation under the three inference settings."""

import time
from typing import Any

import torch
from lightning import Callback, Trainer
from rich.progress import TaskID

from conflow.experiment.build import random_stream
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.evaluation import Evaluation, cycle, evaluate
from conflow.experiment.metrics import CollisionRate
from conflow.experiment.module import ConFlow
from conflow.experiment.progress import ProgressDisplay

VALIDATION_SAMPLES = 256


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


class Evaluate(Callback):
    """Evaluates on the test demonstrations when training ends, and takes a small sample at every validation.

    Attributes:
        done: the evaluation, there when training has ended.
    """

    done: Evaluation

    def __init__(self, data: DemonstrationData, display: ProgressDisplay) -> None:
        self.data, self.display = data, display

    def on_validation_end(self, trainer: Trainer, pl_module: Any) -> None:
        if trainer.logger is None:
            return
        model: ConFlow = pl_module
        x_1 = cycle(self.data.val.x, min(VALIDATION_SAMPLES, model.config.sample.num)).to(model.device)
        noise = random_stream("validation samples", model.config.seed, device=model.device)
        rate = CollisionRate("robot_collision", model.robots).to(model.device)
        rate.update(model.sample(x_1, "none", noise))
        metrics = {f"val/none/{name}": value for name, value in rate.compute().items()}
        # val/loss goes along: Lightning would log it at the step before.
        metrics["val/loss"] = float(trainer.callback_metrics["val/loss"])
        trainer.logger.log_metrics(metrics, trainer.global_step)

    def on_train_end(self, trainer: Trainer, pl_module: Any) -> None:
        self.done = evaluate(pl_module.eval(), self.data.test.x, self.display)
        if trainer.logger is not None:
            # One value a run: at step 0 MLflow draws bars that compare runs, at any other a line of one point.
            trainer.logger.log_metrics(self.done.keyed(), 0)
