"""Two Franka Pandas on a table that face each other and swap sides."""

from collections.abc import Sequence
from math import pi

import torch
from torch import Tensor

from conflow.scene.arms import Arms, Base
from conflow.scene.panda import PANDA
from conflow.scene.tasks.arms import ArmTask, Known
from conflow.scene.tasks.curves import uniform

NOMINAL = (0.0, 0.2, 0.0, -2.0, 0.0, 2.2, pi / 4)
SWEEP = pi / 4
"""Joint 1 goes from minus this to this."""
SPHERES = ((0.0, 0.0, 0.7, 0.08),)


class Pandas(ArmTask):
    """Joint 1 of both sweeps from -45 to 45 degrees, so that straight ways always collide, and both lift their hands.

    A lift h, uniform in [-0.1, `lift`], is taken from joint 2, and 0.3 to 1 times as much from joint 4; joint 1
    deviates by up to 0.25, joint 6 by 0.2.

    Args:
        lift: the highest, in radians.
        apart: the bases, in metres.
        obstacles, singles: of `ArmTask`.
    """

    def __init__(self, lift: float = 1.0, apart: float = 1.1, obstacles: Known = "inference", singles: int = 0) -> None:
        for name, value, high in (("lift", lift, 1.0), ("apart", apart, 3.0)):
            if not isinstance(value, int | float) or not 0 < value <= high:
                raise ValueError(f"{name}={value}: expected a number above 0 and at most {high}")
        self.lift = lift
        arms = Arms([PANDA, PANDA], [Base(-apart / 2), Base(apart / 2, turn=pi)])
        super().__init__(arms, SPHERES, obstacles, singles)

    @property
    def swept(self) -> tuple[Sequence[float], Sequence[float]]:
        return (-SWEEP, *NOMINAL[1:]), (SWEEP, *NOMINAL[1:])

    def deviations(self, num: int, generator: torch.Generator) -> Tensor:
        h = -0.1 + (self.lift + 0.1) * torch.rand(num, 2, generator=generator).double()
        elbow = 0.3 + 0.7 * torch.rand(num, 2, generator=generator).double()
        b = torch.zeros(num, 2, 7, dtype=torch.float64)
        b[..., 1], b[..., 3] = -h, -elbow * h
        b[..., 0], b[..., 5] = (by * uniform(generator, num, 2).double() for by in (0.25, 0.2))
        return b
