"""Many discs in a square, learned from trajectories of single robots."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Self

import numpy as np
import torch
from torch import Tensor

from conflow.scene.constraint import Constraint
from conflow.scene.crowd import CrowdAvoidance, MapAvoidance
from conflow.scene.errors import DemonstrationError
from conflow.scene.robots import Crowd
from conflow.scene.task import SceneTask, Task

AMPLITUDES = (0.15, 0.075, 0.05)
"""Of the sinusoids by which a single robot leaves its straight line, as shares of its length."""
ALONG = 0.5
"""How much of that it deviates along its line, so that speeds vary."""
LARGEST = 0.075
"""Radius of a disc: the published starts keep 0.15 from each other."""


class CrowdTask(SceneTask):
    """So many discs that no joint demonstration exists: each robot's own are drawn independently, and put together.

    All of them collide, so a model learns from D- alone, or from what `data.repair` makes of it.

    Args:
        robots: how many, by default `numbers`; of several training takes turns, and a run is measured at the largest.
        radius: of every disc.
    """

    T, seconds = 64, 5.0
    numbers: Sequence[int] = (10, 20, 28)
    robots: Crowd

    def __init__(self, robots: int | Sequence[int] | None = None, radius: float = 0.05) -> None:
        robots = self.numbers if robots is None else robots
        counts = sorted({robots} if isinstance(robots, int) else {*robots})
        if not counts or any(type(count) is not int or count < 2 for count in counts):
            raise ValueError(f"robots={robots}: expected a whole number of at least 2, or a list of them")
        if not isinstance(radius, int | float) or not 0 < radius <= LARGEST:
            raise ValueError(f"radius={radius}: expected a number above 0 and at most {LARGEST}")
        self.counts, self.radius, self.robots = counts, radius, Crowd(counts[-1], radius)

    def variants(self) -> Sequence[Task]:
        return [type(self)(count, self.radius) for count in self.counts]

    def of_numbers(self, D: int) -> Self:
        made = type(self)(D // 2, self.radius)
        made.scale, made.seconds = self.scale, self.seconds
        offset = self.offset
        made.offset = [offset[i % 2] for i in range(D)] if isinstance(offset, Sequence) else offset
        return made

    def constraints(self) -> Mapping[str, Constraint]:
        among = {"robot": CrowdAvoidance(self.robots)}
        return among | {"object": MapAvoidance(self.robots, self.boxes())} if self.boxes() else among

    @abstractmethod
    def ends(self, count: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Starts and goals of one scene, (count, 2) each."""

    def in_scene(self, count: int, seed: int, index: int) -> "CrowdTask":
        return self

    def scene(self, count: int, seed: int, index: int) -> Tensor:
        made = self.in_scene(count, seed, index)
        start, goal = made.ends(count, np.random.default_rng([*self.name.encode(), count, seed, index]))
        if min(_closest(start), _closest(goal)) < 2 * made.robots.radius:
            raise DemonstrationError(f"robots={count}: expected fewer, so many of radius {made.radius} find no room")
        return torch.from_numpy(np.stack([start, goal]).reshape(2, -1)).float()

    def demonstrations(self, num: int, seed: int) -> Tensor:
        scenes = torch.stack([self.scene(self.robots.count, seed, index) for index in range(num)])
        return self.between(scenes, torch.Generator().manual_seed(seed))

    def between(self, ends: Tensor, generator: torch.Generator) -> Tensor:
        return singles(ends, self.T, generator)


def _closest(places: np.ndarray) -> float:
    """The smallest distance between two of places (count, 2)."""
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    return float(apart[np.triu_indices(len(places), 1)].min())


def singles(ends: Tensor, T: int, generator: torch.Generator) -> Tensor:
    """A trajectory of each robot's own for starts and goals (num, 2, D), (num, T, D).

    x(s) = p + s (q - p) + |q - p| sum_k sin(k pi s) (a_k n + b_k u) with u along q - p and n to its left; a_k is
    uniform in +-AMPLITUDES[k - 1], and b_k in ALONG times that.
    """
    p, q = ends.unflatten(2, (-1, 2)).unbind(dim=1)
    travel = q - p
    across = torch.stack([-travel[..., 1], travel[..., 0]], dim=-1)
    s = torch.linspace(0, 1, T, dtype=torch.float64)
    k = torch.arange(1, len(AMPLITUDES) + 1)
    waves = torch.from_numpy(np.sin((torch.pi * k[:, None] * s).numpy())).float() * torch.tensor(AMPLITUDES)[:, None]
    waves[:, -1] = 0  # sin(k pi) in floating point is not
    a, b = 2 * torch.rand(2, *p.shape[:2], len(AMPLITUDES), generator=generator) - 1
    line = torch.lerp(p[:, None], q[:, None], s.float()[:, None, None])
    deviation = torch.einsum("bnk,kt,bnc->btnc", a, waves, across) + torch.einsum(
        "bnk,kt,bnc->btnc", ALONG * b, waves, travel
    )
    return (line + deviation).flatten(2)
