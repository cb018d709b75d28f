"""Robots that start and end anywhere, in the empty square or in a map."""

import numpy as np
import torch
from torch import Tensor

from conflow.scene.crowd import MapAvoidance
from conflow.scene.measures import leaves_workspace
from conflow.scene.robots import Crowd
from conflow.scene.tasks.crowd import AMPLITUDES, CrowdTask, singles

BORDER = 0.95
"""Starts and goals are within +- this."""
TRIES = 10_000
CANDIDATES, WIDEST, SCENES = 32, 0.8, 32
"""Curves that a robot tries, how far the widest swerve in a map, and scenes of which they are held at a time."""


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
        raise ValueError(f"robots={count}: expected fewer, so many find no room {self.apart} apart")

    def singles(self, ends: Tensor, generator: torch.Generator) -> Tensor:
        """As in an empty square, of CANDIDATES curves that each robot tries the clearest, none of which leaves it.

        The first is nearly straight; in a map others go a long way round.
        """
        # Few scenes at a time: of a thousand all curves would take gigabytes.
        return torch.cat([self._clearest(piece, generator) for piece in ends.split(SCENES)])

    def _clearest(self, ends: Tensor, generator: torch.Generator) -> Tensor:
        num, count = len(ends), ends.shape[2] // 2
        tried = ends.repeat_interleave(CANDIDATES, dim=0)
        spread = torch.ones(len(tried), count)
        if self.boxes():
            length = torch.linalg.vector_norm((tried[:, 1] - tried[:, 0]).unflatten(1, (-1, 2)), dim=2)
            spread = torch.rand(spread.shape, generator=generator) * WIDEST / (AMPLITUDES[0] * length)
        spread[::CANDIDATES] = 0
        x = singles(tried, self.T, generator, spread).view(num, CANDIDATES, self.T, count, 2)
        each, alone = x.transpose(2, 3).reshape(-1, self.T, 2), Crowd(1, self.robots.radius)
        clearance = MapAvoidance(alone, self.boxes()).clearance(each).amin(dim=1) if self.boxes() else each[:, 0, 0] * 0
        clearance = torch.where(leaves_workspace(each), -torch.inf, clearance.clamp(max=0))
        # Of the clear ones any: the clearest would all keep far away.
        best = clearance.view(num, CANDIDATES, count).flip(1).argmax(dim=1)
        return x.flip(1).take_along_dim(best[:, None, None, :, None], dim=1)[:, 0].flatten(2)
