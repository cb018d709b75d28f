"""Two planar arms of four links that face each other and swap sides: the small case, seen in one picture."""

from collections.abc import Sequence
from math import pi

import torch
from torch import Tensor

from conflow.scene.arms import Arms, Base, Body, Chain
from conflow.scene.tasks.arms import ArmTask, Known
from conflow.scene.tasks.curves import some, uniform

LINKS, LENGTH, THICK = 4, 0.25, 0.05
DISCS = 5
"""Along each link."""
BASE = 0.94
"""Of both arms, left and right of the middle."""
SWEEP = pi / 4
"""Joint 1 goes from minus this to this; else the arms are straight at both ends."""
OBSTACLE = (0.0, 0.3, 0.0, 0.04)


def planar(links: int, length: float, radius: float, discs: int) -> Chain:
    """An arm in the plane of so many equal links, each covered by discs."""
    along = [(length * (k + 0.5) / discs, 0.0, 0.0, radius) for k in range(discs)]
    return Chain(
        joints=[(length if j else 0.0, 0.0, 0.0) for j in range(links)],
        low=[-pi + 0.2] * links,
        high=[pi - 0.2] * links,
        speed=[4.0] * links,
        bodies=[Body(j + 1, along) for j in range(links)],
        hand=(length, 0.0, 0.0),
    )


class PlanarArms(ArmTask):
    """Joint 1 of both sweeps from -45 to 45 degrees; stretched arms collide, so both fold on the way.

    A fold h, uniform in [-0.1, `fold`], to either side: joint 2 turns by h, joint 3 by -2 h and joint 4 by h, which
    draws the hand in; joint 1 deviates by up to 0.25.

    A step between two of 64 waypoints is shorter than the arms are thick, so that none passes through the other.

    Args:
        fold: the largest, in radians.
        obstacles, singles: of `ArmTask`.
    """

    T = 64

    def __init__(self, fold: float = 1.3, obstacles: Known = "inference", singles: int = 0) -> None:
        if not isinstance(fold, int | float) or not 0 < fold <= 1.3:
            raise ValueError(f"fold={fold}: expected a number above 0 and at most 1.3")
        self.fold = fold
        chain = planar(LINKS, LENGTH, THICK, DISCS)
        arms = Arms([chain, chain], [Base(-BASE), Base(BASE, turn=pi)], axes=2)
        super().__init__(arms, [OBSTACLE], obstacles, singles)

    @property
    def swept(self) -> tuple[Sequence[float], Sequence[float]]:
        return (-SWEEP, 0.0, 0.0, 0.0), (SWEEP, 0.0, 0.0, 0.0)

    def deviations(self, num: int, generator: torch.Generator) -> Tensor:
        h = -0.1 + (self.fold + 0.1) * torch.rand(num, 2, generator=generator).double()
        h = torch.where(some(0.5, 2 * num, generator).view(num, 2), h, -h)
        return torch.stack([0.25 * uniform(generator, num, 2).double(), h, -2 * h, h], dim=2)
