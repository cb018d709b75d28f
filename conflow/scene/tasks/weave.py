"""Robots on the border of a square that all cross to the other side."""

import math
from collections.abc import Sequence
from typing import Self

import numpy as np

from conflow.scene.robots import Crowd
from conflow.scene.tasks.crowd import CrowdTask

REACH, SIDE = 0.8, 0.87
"""Radius of the circle on which robots are spread, and the side that they are moved to."""
PHASE, JITTER = 0.005, 0.0025
"""By how much scenes differ: a turn of all in radians, and of each by a share of their spacing."""


class Weave(CrowdTask):
    """Starts spread along the border of a square, goals straight across: the benchmark of Akule and others.

    theta_i = 2 pi i / N, turned and jittered a little; p = 0.8 (cos, sin). Where |x| > |y| the robot starts at
    x = +-0.87 and crosses horizontally, elsewhere it starts at y = +-0.87 and crosses vertically. 28 robots are the
    most whose starts keep 0.15.
    """

    def ends(self, count: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        spacing = 2 * np.pi / count
        turn, each = draw.uniform(-PHASE, PHASE), draw.uniform(-JITTER, JITTER, count)
        theta = spacing * (np.arange(count) + each) + turn
        start = REACH * np.stack([np.cos(theta), np.sin(theta)], axis=1)
        horizontal = np.abs(start[:, 0]) > np.abs(start[:, 1])
        crossing = np.where(horizontal, 0, 1)[:, None]
        np.put_along_axis(start, crossing, SIDE * np.sign(np.take_along_axis(start, crossing, 1)), 1)
        goal = start.copy()
        np.put_along_axis(goal, crossing, -np.take_along_axis(start, crossing, 1), 1)
        return start, goal


class ScaledWeave(Weave):
    """`Weave` of more robots in a world that grows with them, so that starts keep 0.15 of its units.

    The world is s = max(1, 1.001 0.15 N sqrt(2) / (0.8 2 pi 0.995)) times as large; here it stays [-1, 1]^2, discs are
    s times smaller, and `scale` is s.
    """

    numbers = (40, 64)

    def __init__(self, robots: int | Sequence[int] | None = None, radius: float = 0.05) -> None:
        super().__init__(robots, radius)
        count = self.robots.count
        self.scale = max(1.0, 1.001 * 0.15 * count * math.sqrt(2) / (REACH * 2 * math.pi * 0.995))
        self.robots = Crowd(count, radius / self.scale)

    def of_numbers(self, D: int) -> Self:
        return type(self)(D // 2, self.radius)
