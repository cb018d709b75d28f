"""Sampling a model under every inference setting, and measuring what it made."""

import time
from dataclasses import dataclass, field
from statistics import median

import torch
from torch import Tensor

from conflow.flow.sampler import PIECE
from conflow.scene.measures import endpoint_error
from conflow.training.build import NONE, random_stream
from conflow.training.config import SPLITS, SplitName
from conflow.training.datamodule import Split
from conflow.training.metrics import EnergyDistance, trajectory_metrics
from conflow.training.model import ConFlow, start_and_goal
from conflow.training.progress import ProgressDisplay

LATENCY_BATCH = 256
UNCHANGED = "same settings"
"""The label of a run that was sampled again as it is."""
EVALUATED_ON_VALIDATION = "evaluate/val "
"""Begins the metrics of a run that was sampled again on the validation split; on test a label follows `evaluate/`."""

Metrics = dict[str, float]


@dataclass
class Evaluation:
    """What a model makes of its source for given starts and goals.

    Attributes:
        source_samples: x_0 of the source, (num, T, D), the same for every setting.
        samples: the trajectories of each setting, (num, T, D).
        results: the metrics of each setting.
        baseline: of the test split, the same metrics of what no model touched: "data", the demonstrations themselves,
            "feasible", D+ of them alone, and "source".
    """

    source_samples: Tensor
    samples: dict[str, Tensor] = field(default_factory=dict)
    results: dict[str, Metrics] = field(default_factory=dict)
    baseline: dict[str, Metrics] = field(default_factory=dict)

    def keyed(self, prefix: str = "test/", baseline: bool = True) -> Metrics:
        """The metrics under their names in MLflow."""
        groups = {f"{prefix}{setting}": metrics for setting, metrics in self.results.items()}
        if baseline:
            groups |= {f"without_model/{name}": metrics for name, metrics in self.baseline.items()}
        return {f"{group}/{name}": value for group, metrics in groups.items() for name, value in metrics.items()}


@torch.no_grad()
def evaluate(
    model: ConFlow, split: Split, display: ProgressDisplay, name: SplitName = "test", timed: Evaluation | None = None
) -> Evaluation:
    """Sample `sample.num` trajectories under every setting and measure them.

    Each gets the start and goal of a demonstration of the split, the first again after the last. All settings start
    from the same x_0, which depends on the seed alone, so they differ by their guidance only. D+ of the split, by its
    labels, is what the energy distance is taken to.

    Args:
        model: what to sample.
        split: the demonstrations.
        display: for progress.
        name: the split's. Each has noise of its own, and what no model touched is measured on the test split alone.
        timed: an evaluation of the same model, whose latencies hold here too; without it they are measured.
    """
    task = display.add(f"sampling {SPLITS[name]}", len(model.settings))
    demonstrations, violates = split.x.to(model.device), split.violates.to(model.device)
    feasible = demonstrations[~violates]
    reference = feasible if len(feasible) > 1 else None  # one has no distance to another
    x_1 = cycle(demonstrations, model.config.sample.num)
    y = model.source.observe(x_1)
    x_0 = model.source.sample(y, random_stream(f"{name} samples", model.config.seed, device=model.device))
    evaluation = Evaluation(x_0.cpu())
    if name == "test":
        # These two hold the reference itself, so their energy distance to it is not one of independent samples.
        evaluation.baseline["data"] = measure(model, demonstrations, demonstrations, None)
        if reference is not None:
            evaluation.baseline["feasible"] = measure(model, feasible, feasible, None)
            if int(violates.sum()) > 1:
                evaluation.baseline["data"] |= _mixture_distance(demonstrations[violates], feasible)
        evaluation.baseline["source"] = measure(model, x_0, x_1, reference)
    for done, setting in enumerate(model.settings, start=1):
        x = model.flow(x_0, setting, start_and_goal(x_1))
        evaluation.samples[setting] = x.cpu()
        drift = {
            f"{name}_drift": float(
                endpoint_error(model.task.robots, x.cpu(), evaluation.samples[NONE], waypoint).mean()
            )
            for name, waypoint in {"start": 0, "end": -1}.items()
        }
        latency = timed.results[setting]["latency_ms"] if timed else _latency_ms(model, x_1, setting)
        evaluation.results[setting] = measure(model, x, x_1, reference, setting) | drift | {"latency_ms": latency}
        display.update(task, done, f"setting {setting}")
    return evaluation


def measure(model: ConFlow, x: Tensor, x_1: Tensor, reference: Tensor | None, setting: str = NONE) -> Metrics:
    """The metrics of trajectories x whose starts and goals were those of x_1, both (num, T, D).

    With the energy distance to a reference (m, T, D) where there is one; success is to keep what the setting asks for.
    """
    metrics = trajectory_metrics(model.judged, model.trained, reference, model.required(setting)).to(model.device)
    for piece, demonstrated in zip(x.split(PIECE), x_1.split(PIECE), strict=True):
        metrics.update(x=piece, x_1=demonstrated)
    return metrics.compute() | {"num": len(x)}


def cycle(x: Tensor, num: int) -> Tensor:
    """The first `num` rows of x, beginning again where there are fewer."""
    return x[torch.arange(num) % len(x)]


def _mixture_distance(negatives: Tensor, feasible: Tensor) -> Metrics:
    """The energy distance of D+ and D- together to D+ alone, without the distance of D+ to itself.

    With p the share of D-, the laws differ by p (D- - D+). The energy distance is quadratic in the difference, hence
    p^2 times that of D- to D+, which share no trajectory. The interval takes p as known.
    """
    p = len(negatives) / (len(negatives) + len(feasible))
    metric = EnergyDistance(feasible)
    metric.update(negatives)
    return {name: p**2 * value for name, value in metric.compute().items()}


def latency_batch(D: int) -> int:
    """Trajectories in the batch whose time is taken: 256 of two robots in the plane, fewer of what has more numbers."""
    return max(1, 4 * LATENCY_BATCH // D)


def _latency_ms(model: ConFlow, x_1: Tensor, setting: str, repetitions: int = 3) -> float:
    """Median time of sampling one batch, in milliseconds."""
    x_1 = cycle(x_1, latency_batch(x_1.shape[2]))
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        model.sample(x_1, setting).cpu()  # to the host, so that an accelerator has finished
        times.append(1000 * (time.perf_counter() - start))
    return median(times)
