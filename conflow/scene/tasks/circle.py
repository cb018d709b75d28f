"""Robots on a circle that all cross to the opposite side, through its centre."""

import numpy as np

from conflow.scene.tasks.crowd import CrowdTask
from conflow.scene.tasks.weave import JITTER, PHASE, REACH


class Circle(CrowdTask):
    """Starts equally spaced on the circle of radius 0.8, goals antipodal, turned and jittered as in `Weave`."""

    def ends(self, count: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        turn, each = draw.uniform(-PHASE, PHASE), draw.uniform(-JITTER, JITTER, count)
        theta = 2 * np.pi / count * (np.arange(count) + each) + turn
        start = REACH * np.stack([np.cos(theta), np.sin(theta)], axis=1)
        return start, -start
