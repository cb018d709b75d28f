"""ConFlow as a LightningModule: Algorithm 1 of the paper, and sampling from what it trained."""

from functools import partial
from typing import Any, Literal, get_args

import torch
import torch.nn.functional as F
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler, OneCycleLR

from conflow.errors import ConfigError
from conflow.flow.correction import Correction
from conflow.flow.network import SpectralMLP
from conflow.flow.path import end, guided_path, interpolate, velocity
from conflow.flow.sampler import GUIDANCE, Field, in_pieces, integrate
from conflow.scene.constraint import Constraint, Sum
from conflow.training.build import (
    build_source,
    correction,
    judge,
    kept,
    network,
    obstacle_avoidance,
    random_stream,
    robot_avoidance,
)
from conflow.training.config import Config

Setting = Literal["none", "robot", "obstacle"]
SETTINGS: tuple[Setting, ...] = get_args(Setting)
"""The paper's three inference settings: without guidance, guided around the other robot, around an obstacle."""


class DivergedError(ConfigError):
    """A loss or gradient that is not finite: of which step, and what there is from before, in one line."""


class ConFlow(LightningModule):
    """Constraint-guided flow matching.

    Args:
        config: the experiment.
        T, D: waypoints and dimensions of a trajectory.
    """

    def __init__(self, config: Config, T: int, D: int) -> None:
        super().__init__()
        self.config, self.T, self.D = config, T, D
        self.source = build_source(config.source, T)
        self.robots, self.obstacle = judge(config, D), obstacle_avoidance(config, D)
        self.v = network(config.network, self.source, D, robot_avoidance(config, D))
        margin = config.correction.margin
        self.u_c = correction(config.correction, kept(config, D), self.source)
        self.u_c_obstacle = correction(config.correction, obstacle_avoidance(config, D, margin), self.source)
        self.grad_norm = torch.zeros(())

    def training_step(self, batch: tuple[Tensor, Tensor], step: int) -> Tensor:
        loss = self.loss(*batch, random_stream("training", self.config.seed, step, device=self.device))
        if loss.device.type == "cpu":
            self.check_finite("the loss", loss, step)
        return loss

    def validation_step(self, batch: tuple[Tensor, Tensor], _: int) -> None:
        # The same draws at every validation, so that val/loss moves with the network alone.
        noise = random_stream("validation", self.config.seed, device=self.device)
        self.log("val/loss", self.loss(*batch, noise), batch_size=len(batch[0]), logger=False)

    def fit(self, x_1: Tensor) -> None:
        """What is known of the demonstrations x_1 (N, T, D) before training."""
        if isinstance(self.v, SpectralMLP):
            self.v.fit(x_1)

    def loss(self, x_1: Tensor, M: Tensor, noise: torch.Generator) -> Tensor:
        """L_CG (Eq. cg_loss) for demonstrations x_1 (batch, T, D) and their violations M (batch,): Algorithm 1."""
        lambda_c, ends = self.config.correction.lambda_c, start_and_goal(x_1)
        M = M if self.config.correction.mask == "violates" else ~M
        x_0 = self.source.sample(self.source.observe(x_1), noise)
        t = torch.rand(len(x_1), device=x_1.device, generator=noise)
        if self.config.correction.path == "guided":
            x_t, u_t = guided_path(x_0, x_1, t, self.u_c, lambda_c * M)
            return self.distance(self.v(x_t, t, ends), u_t)
        x_t = interpolate(x_0, x_1, t)
        v = self.v(x_t, t, ends)
        if self.config.correction.at == "end":
            # The barrier is its own mask: nothing to correct where the predicted end is feasible.
            u_c = (t**self.config.correction.ramp)[:, None, None] * self.u_c(end(x_t, v.detach(), t))
        else:
            u_c = M[:, None, None] * self.u_c(x_t)
        return self.distance(v, velocity(x_0, x_1) + lambda_c * u_c)

    def distance(self, v: Tensor, u: Tensor) -> Tensor:
        """|v - u|^2 of velocities (batch, T, D), the mean over batch, waypoints and dimensions, or over modes."""
        if self.config.train.norm == "modes":
            assert isinstance(self.v, SpectralMLP)  # the config was checked
            v, u = self.v.balanced(v), self.v.balanced(u)
        return F.mse_loss(v, u)

    def required(self, setting: Setting) -> Constraint:
        """All that trajectories of a setting must keep: the obstacle stands there in its own setting alone."""
        return Sum([self.robots, self.obstacle]) if setting == "obstacle" else self.robots

    def field(self, setting: Setting, ends: Tensor | None = None) -> Field:
        """The velocity field of a setting, for starts and goals (batch, 2, D) where the network sees them."""
        sample, v = self.config.sample, partial(self.v, ends=ends)
        robots, obstacle = (self.u_c, sample.robot_weight), (self.u_c_obstacle, sample.obstacle_weight)
        if setting == "none":
            return v
        if setting == "robot":
            return self.guided(v, robots)
        # What descent moves it puts somewhere for good, so there it has to keep everything at once.
        return self.guided(v, robots, obstacle) if sample.guidance == "descent" else self.guided(v, obstacle)

    def guided(self, v: Field, *weighted: tuple[Correction, float]) -> Field:
        """A field guided by corrections u^c with their weights lambda, in the way that `sample.guidance` says."""

        def push(x: Tensor) -> Tensor:
            return torch.stack([weight * u_c(x) for u_c, weight in weighted]).sum(dim=0)

        return GUIDANCE[self.config.sample.guidance](v, push)

    def sample(self, x_1: Tensor, setting: Setting = "none", noise: torch.Generator | None = None) -> Tensor:
        """Trajectories from where each x_1 starts to where it ends, both (batch, T, D)."""
        return self.flow(self.source.sample(self.source.observe(x_1), noise), setting, start_and_goal(x_1))

    def flow(self, x_0: Tensor, setting: Setting = "none", ends: Tensor | None = None) -> Tensor:
        """Where the ODE of `field` takes samples x_0 of the source, (batch, T, D)."""

        def arrive(x_0: Tensor, ends: Tensor | None = None) -> Tensor:
            return integrate(self.field(setting, ends), x_0, self.config.sample.steps, self.config.sample.solver)

        return in_pieces(arrive, x_0) if ends is None else in_pieces(arrive, x_0, ends)

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
        described = {"config": self.config.tree(), "T": self.T, "D": self.D, "threads": torch.get_num_threads()}
        checkpoint["conflow"] = described


def start_and_goal(x: Tensor) -> Tensor:
    """The first and the last waypoint of trajectories (batch, T, D), (batch, 2, D)."""
    return x[:, [0, -1]]
