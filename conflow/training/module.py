"""ConFlow in training: what Lightning asks for around the loss."""

from typing import Any

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler, OneCycleLR

from conflow.errors import ConfigError
from conflow.scene.task import Task, plain
from conflow.tracking import ranks
from conflow.training.build import random_stream
from conflow.training.config import Config
from conflow.training.model import ConFlow


class DivergedError(ConfigError):
    """A loss or gradient that is not finite: of which step, and what there is from before, in one line."""


class Training(ConFlow, LightningModule):
    """The training of a ConFlow, which it is itself."""

    def __init__(self, config: Config, task: Task) -> None:
        super().__init__(config, task)
        self.grad_norm = torch.zeros(())

    def training_step(self, batch: tuple[Tensor, Tensor], step: int) -> Tensor:
        noise = random_stream("training", self.config.seed, step, device=self.device)
        loss = self.loss(*batch, noise, ranks.share(len(batch[0])))
        # Of several processes one alone must not stop: to all of them the norm of the gradient tells it.
        if loss.device.type == "cpu" and ranks.world() == 1:
            self.check_finite("the loss", loss, step)
        return loss

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        # The same draws at every validation, so that val/loss moves with the network alone.
        noise = random_stream("validation", self.config.seed, device=self.device)
        self.log("val/loss", self.loss(*batch, noise), batch_size=len(batch[0]), logger=False)

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        train = self.config.train
        optimizer = AdamW(self.v.parameters(), lr=train.lr, fused=True)
        schedule: LRScheduler = (
            OneCycleLR(optimizer, train.lr, total_steps=train.max_steps)
            if train.schedule == "one_cycle"
            else LambdaLR(optimizer, lambda step: 1.0)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def configure_gradient_clipping(self, optimizer: Optimizer, *_: Any, **__: Any) -> None:
        """Clips as the Trainer would, and keeps the norm that clipping computes anyway."""
        self.grad_norm = nn.utils.clip_grad_norm_(self.v.parameters(), self.config.train.clip)
        if self.grad_norm.device.type == "cpu":
            self.check_finite("the norm of the gradient", self.grad_norm, self.global_step)

    def check_finite(self, name: str, value: Tensor, step: int) -> None:
        """Stop the training at a number of this step that is none.

        On the CPU called at every step, before the weights change. On an accelerator reading a number would make the
        loop wait for it, so there it is left to `TrainingLog`.

        Raises:
            DivergedError: the value is not finite.
        """
        if not bool(value.isfinite()):
            raise DivergedError(
                f"{name} is {float(value)}, expected a finite number: step {step}, batch of seed {self.config.seed} "
                f"and step {step}, train.lr={self.config.train.lr:g}"
            )

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        # Another number of threads adds up in another order, and bits differ.
        torch.set_num_threads(checkpoint["conflow"]["threads"])

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["conflow"] = {
            "config": self.config.tree(),
            "T": self.T,
            "D": self.D,
            "threads": torch.get_num_threads(),
            # Plain, since a file that is read without running code may hold no others.
            "scale": plain(self.task.scale),
            "offset": plain(self.task.offset),
            "seconds": plain(self.task.seconds),
        }
