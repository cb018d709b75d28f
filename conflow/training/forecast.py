"""How long a training is going to take on this machine, measured before it begins."""

import time
from itertools import islice
from statistics import median
from typing import Any, get_args

import torch
from lightning import Callback, Trainer
from rich.console import Console
from torch import Tensor, nn
from torch.optim import AdamW

from conflow.training.build import random_stream
from conflow.training.config import Precision
from conflow.training.module import Training

BUDGET = 1.0
"""Seconds of measuring, for each precision; a step that takes longer is measured once."""
SHARE = 0.01
"""Of all steps, that are measured at most."""
WORTH_SECONDS, WORTH_SHARE = 60.0, 0.2
"""What another precision has to save before it is hinted at, in seconds and as a share."""

Batch = tuple[Tensor, Tensor]


class Forecast(Callback):
    """Says before the first step how long all of them will take, and in which precision it would be shorter."""

    def __init__(self, console: Console) -> None:
        self.console = console

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        steps = trainer.max_steps - trainer.global_step
        if steps <= 0:
            return
        # Batches of its own: those of the training know how far they are.
        batches = trainer.datamodule.train_dataloader()  # type: ignore[attr-defined]
        some, most = list(islice(batches, len(batches.splits))), max(1, int(SHARE * steps))
        chosen: Precision = pl_module.config.train.precision
        seconds = steps * step_seconds(pl_module, some, chosen, most)
        hint = ""
        if seconds > WORTH_SECONDS:
            (other,) = (precision for precision in get_args(Precision) if precision != chosen)
            instead = steps * step_seconds(pl_module, some, other, most)
            if seconds - instead > max(WORTH_SECONDS, WORTH_SHARE * seconds):
                hint = f"; with train.precision={other} about {duration(instead)}"
        said = f"{steps} steps of {seconds / steps:.2g} s on this machine: about {duration(seconds)} of training{hint}"
        self.console.print(said, highlight=False, soft_wrap=True)


def step_seconds(model: Training, batches: list[Batch], precision: Precision, most: int) -> float:
    """The median time of a step of training, of which the model keeps no trace.

    Args:
        model: in training, on its device.
        batches: the steps' in turn.
        precision: of the network's layers.
        most: how many steps are measured at most.
    """
    weights = list(model.v.parameters())
    stand_ins = [nn.Parameter(weight.detach().clone()) for weight in weights]
    optimizer = AdamW(stand_ins, fused=True)

    def step(batch: Batch) -> None:
        loss = model.loss(*batch, random_stream("forecast", device=model.device))
        for stand_in, g in zip(stand_ins, torch.autograd.grad(loss, weights, allow_unused=True), strict=True):
            stand_in.grad = g
        float(nn.utils.clip_grad_norm_(stand_ins, model.config.train.clip))  # an accelerator has got as far as this
        optimizer.step()

    chosen, model.v.bf16 = model.v.bf16, precision == "bf16"
    try:
        spent = [_timed(step, batches[0])]  # the first one also makes what later ones find
        while len(spent) <= most and sum(spent) < BUDGET:
            spent.append(_timed(step, batches[len(spent) % len(batches)]))
    finally:
        model.v.bf16 = chosen
    return median(spent[1:] or spent)


def _timed(step: Any, batch: Batch) -> float:
    start = time.perf_counter()
    step(batch)
    return time.perf_counter() - start


def duration(seconds: float) -> str:
    """In two units at most.

    >>> duration(6180), duration(125), duration(0.4)
    ('1 h 43 min', '2 min', '0.4 s')
    """
    if seconds < 100:
        return f"{seconds:.2g} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 100 else f"{minutes} min"
