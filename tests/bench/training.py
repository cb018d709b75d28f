"""A step of training: `make train`'s loop, the shortest raw loop, and that loop with other libraries' paths."""

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import torch
import torch.nn.functional as F
from lightning import Callback, Trainer
from rich.console import Console
from torch import Tensor, nn
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR, LRScheduler, OneCycleLR

from conflow.flow.path import interpolate, velocity
from conflow.flow.source import rbf
from conflow.tracking import recording
from conflow.training import config
from conflow.training.config import Config
from conflow.training.datamodule import DemonstrationData
from conflow.training.progress import ProgressDisplay
from conflow.training.train import experiment, trainer
from tests.bench import peers
from tests.bench.clock import Block, Pace, Row, Target, alternate, beside, block, compared
from tests.bench.peers import StraightPath
from tests.papers import model_of

RAW, FULL_RATE = "raw PyTorch loop", "its matrix products alone, at full rate"
TARGETS = {"paper": {RAW: Target(1.03), FULL_RATE: Target(1 / 0.8)}, "quick": {RAW: Target(1.1)}}
METHOD, METHOD_SHARE = "source + path + correction", 0.1
"""What may take this part of a step together."""


def rows(preset: str, pace: Pace) -> list[Row]:
    """The lines about a step of training at a preset."""
    settings = config.load([f"preset={preset}"])
    part, raw = f"a training step, {preset} size", RawLoop(settings)
    others: dict[str, Block | None] = {
        f"raw loop, {name}'s path": path and RawLoop(settings, path).run for name, path in peers.paths().items()
    }
    with Loop(settings) as loop:
        found = beside(
            part,
            "make train",
            loop.run,
            {RAW: raw.run, FULL_RATE: full_rate(settings), **others},
            pace,
            "time",
            TARGETS.get(preset),
        )
    return found + _parts(part, raw, pace)


def _parts(part: str, raw: "RawLoop", pace: Pace) -> list[Row]:
    """Where the time of a step goes."""
    model, (x_1, M) = raw.model, raw.batch()
    x_0, t = model.source.sample(model.source.observe(x_1)), torch.rand(len(x_1))
    x_t, u_t, parameters = interpolate(x_0, x_1, t), velocity(x_0, x_1), list(model.v.parameters())

    def network() -> None:
        raw.optimizer.zero_grad()
        F.mse_loss(model.v(x_t, t), u_t).backward()

    network()
    pieces: dict[str, Callable[[], object]] = {
        "batch": raw.batch,
        "source": lambda: model.source.sample(model.source.observe(x_1)),
        "path": lambda: (interpolate(x_0, x_1, t), velocity(x_0, x_1)),
        "correction": lambda: u_t + raw.lambda_c * M[:, None, None] * model.u_c(x_t),
        "network, forward and back": network,
        "clipping": lambda: nn.utils.clip_grad_norm_(parameters, model.config.train.clip),
        "optimiser": raw.optimizer.step,
    }
    blocks = {name: block(piece) for name, piece in pieces.items()} | {"step": raw.run}
    seconds = alternate(blocks, pace)
    whole = seconds.pop("step")
    seconds[METHOD] = [sum(one) for one in zip(*(seconds[name] for name in METHOD.split(" + ")), strict=True)]
    return [
        compared(part, name, "the raw step", one, whole, "share", Target(METHOD_SHARE) if name == METHOD else None)
        for name, one in seconds.items()
    ]


class RawLoop:
    """The shortest loop in plain PyTorch that trains the paper's method: its mathematics, nothing logged or checked.

    Args:
        settings: the experiment, of which it takes the paper's own.
        path: another library's straight path in place of two lines.
    """

    def __init__(self, settings: Config, path: StraightPath | None = None) -> None:
        data = DemonstrationData(settings)
        self.model, self.path, self.batch_size = model_of(settings, data.T, data.D), path, settings.train.batch_size
        self.x, self.violates = data.train
        source, constraint = settings.source, settings.constraint
        K, ends = rbf(data.T, source.length_scale, source.sigma_f, source.epsilon), [0, data.T - 1]
        W = K[:, ends] @ K[ends][:, ends].inverse()
        Sigma = (K - W @ K[ends])[1:-1, 1:-1]
        L = F.pad(torch.linalg.cholesky(Sigma), (0, 0, 1, 1))
        self.W, self.L, self.S = W.float(), L.float(), self.model.u_c.smoothing
        self.radius, self.gamma, self.lambda_c = constraint.radius, constraint.gamma, settings.correction.lambda_c
        self.optimizer = AdamW(self.model.v.parameters(), settings.train.lr, fused=True)
        self.schedule: LRScheduler = (
            OneCycleLR(self.optimizer, settings.train.lr, total_steps=10**6)
            if settings.train.schedule == "one_cycle"
            else LambdaLR(self.optimizer, lambda step: 1.0)
        )

    def batch(self) -> tuple[Tensor, Tensor]:
        """x_1 and M."""
        i = torch.randint(len(self.x), (self.batch_size,))
        return self.x[i], self.violates[i]

    def target(self, x_0: Tensor, x_1: Tensor, t: Tensor, M: Tensor) -> tuple[Tensor, Tensor]:
        """x_t and the corrected velocity."""
        s = t[:, None, None]
        x_t, u_t = self.path(x_0, x_1, t) if self.path else ((1 - s) * x_0 + s * x_1, x_1 - x_0)
        w = x_t[..., :2] - x_t[..., 2:]
        d = w.norm(dim=-1, keepdim=True)
        g = torch.sigmoid(self.gamma * (self.radius - d)) / d * w
        return x_t, u_t + self.lambda_c * M[:, None, None] * (self.S @ torch.cat([g, -g], dim=-1))

    def run(self, steps: int) -> float:
        """Seconds of so many steps."""
        return block(self.step)(steps)

    def step(self) -> None:
        """One step of training."""
        x_1, M = self.batch()
        x_0 = self.W @ x_1[:, [0, -1]] + self.L @ torch.randn(len(x_1), self.L.shape[1], x_1.shape[2])
        t = torch.rand(len(x_1))
        x_t, u_t = self.target(x_0, x_1, t, M)
        loss = F.mse_loss(self.model.v(x_t, t), u_t)
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.model.v.parameters(), self.model.config.train.clip)
        self.optimizer.step()
        self.schedule.step()


class Loop:
    """`make train`'s own loop, with everything that it does around a step, in a store of its own: a context manager."""

    def __init__(self, settings: Config) -> None:
        self.settings = settings
        self.data = DemonstrationData(settings)
        self.model = model_of(settings, self.data.T, self.data.D)
        self.tracked = recording.start(experiment(settings, self.data))

    def __enter__(self) -> "Loop":
        self.logger = self.tracked.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.tracked.__exit__(*error)

    def run(self, steps: int) -> float:
        """Seconds of so many steps, after one that is not counted."""
        stopwatch = Stopwatch(steps)
        with ProgressDisplay(Console(quiet=True)) as display:
            loop = trainer(self.settings, self.logger, self.data, display)
            loop.callbacks.append(stopwatch)  # type: ignore[attr-defined]  # Lightning's Trainer has the attribute
            with suppress(EnoughError):
                loop.fit(self.model, self.data)
        return stopwatch.seconds


class EnoughError(Exception):
    """Ends a training without the validation that it would end with."""


class Stopwatch(Callback):
    """The seconds from the end of a training's first step to the end of another."""

    def __init__(self, steps: int) -> None:
        self.steps, self.start, self.seconds = steps, 0.0, 0.0

    def on_train_batch_end(self, trainer: Trainer, *_: Any) -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        if trainer.global_step == 1:
            self.start = time.perf_counter()
        if trainer.global_step == self.steps + 1:
            self.seconds = time.perf_counter() - self.start
            raise EnoughError


def full_rate(settings: Config) -> Block:
    """The seconds of a step's matrix products, were all of them as fast as a hidden layer's, a large square one."""
    h, size = settings.network.hidden, 4 * settings.data.horizon
    a, b = torch.randn(settings.train.batch_size, h), torch.randn(h, h)
    weights = (2 * size + 1) * h + 2 * settings.network.blocks * h**2
    # Forward, back to the weights, and back to the inputs, but for those of the first layer.
    products = (3 * weights - (size + 1) * h) / h**2
    run = block(lambda: a @ b)
    return lambda times: products * run(times)
