"""Robots that start and end anywhere, in the empty square or in a map."""

import numpy as np
import torch
from torch import Tensor

from conflow.scene.crowd import MapAvoidance
from conflow.scene.errors import DemonstrationError
from conflow.scene.robots import Crowd
from conflow.scene.routes import routes
from conflow.scene.tasks.crowd import CrowdTask, singles

BORDER = 0.95
"""Starts and goals are within +- this."""
TRIES = 10_000
SCENES = 32
"""Scenes whose robots find their ways at a time."""


class Random(CrowdTask):
    """Starts and goals uniform in [-0.95, 0.95]^2, each `apart` from the others and `clear` of boxes.

    Attributes:
        apart: centre to centre.
        clear: from a box to the robot's centre.
    """

    apart, clear = 0.15, 0.16

    def ends(self, count: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return self._places(count, draw), self._places(count, draw)

    def _places(self, count: int, draw: np.random.Generator) -> np.ndarray:
        """Points (count, 2), one after the other where there is room."""
        away, found = MapAvoidance(Crowd(1, self.clear), self.boxes()), np.empty((0, 2))
        for _ in range(TRIES):
            place = draw.uniform(-BORDER, BORDER, 2)
            if (np.linalg.norm(found - place, axis=1) < self.apart).any():
                continue
            if self.boxes() and float(away.clearance(torch.from_numpy(place)[None, None])) < 0:
                continue
            found = np.vstack([found, place])
            if len(found) == count:
                return found
        raise DemonstrationError(f"robots={count}: expected fewer, so many find no room {self.apart} apart")

    def between(self, ends: Tensor, generator: torch.Generator) -> Tensor:
        """Nearly straight, along the walls where that would leave the square; in a map on a way through it."""
        if not self.boxes():
            return singles(ends, self.T, generator).clamp(-1, 1)
        # Few scenes at a time: of a thousand all grids would take gigabytes.
        return torch.cat([self._routes(piece, generator) for piece in ends.split(SCENES)])

    def _routes(self, ends: Tensor, generator: torch.Generator) -> Tensor:
        p, q = ends.unflatten(2, (-1, 2)).transpose(0, 1).flatten(1, 2)
        x = routes(p, q, self.boxes(), self.robots.radius, self.T, generator)
        return x.unflatten(0, (len(ends), -1)).transpose(1, 2).flatten(2)
