"""SMD's families of scenes among discs: every scene has its own."""

import copy
from collections.abc import Sequence
from typing import Self

import numpy as np

from conflow.scene.settings import Box
from conflow.scene.tasks.random import BORDER, TRIES, Random

SMALLEST, LARGEST, GAP = 0.05, 0.1, 0.1
"""Radii of the discs, and what they keep from each other."""


class Basic(Random):
    """Ten discs of radius 0.05 to 0.1 a scene, 0.1 and more between them.

    A model learns in the empty square, and meets a scene's discs at planning alone.
    """

    numbers, apart, clear = (9, 18), 0.17, 0.11
    discs = 10

    def __init__(self, robots: int | Sequence[int] | None = None, radius: float = 0.05) -> None:
        super().__init__(robots, radius)
        self.map: Sequence[Box] = ()

    def boxes(self) -> Sequence[Box]:
        return self.map

    def of_numbers(self, D: int) -> Self:
        made = super().of_numbers(D)
        made.map = self.map
        return made

    def in_scene(self, count: int, seed: int, index: int) -> "Basic":
        made = copy.copy(self)
        made.map = _scattered(self.discs, np.random.default_rng([*self.name.encode(), seed, index]))
        return made


class Dense(Basic):
    """As `Basic`, with twenty discs."""

    discs = 20


def _scattered(count: int, draw: np.random.Generator) -> list[Box]:
    """Discs, one after the other where there is room."""
    found: list[Box] = []
    for _ in range(TRIES):
        radius, (x, y) = draw.uniform(SMALLEST, LARGEST), draw.uniform(-BORDER, BORDER, 2)
        if all(np.hypot(x - other.x, y - other.y) >= radius + other.rounding + GAP for other in found):
            found.append(Box(float(x), float(y), 2 * radius, 2 * radius, radius))
            if len(found) == count:
                break
    return found
