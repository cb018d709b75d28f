"""Two robots that swap sides and evade each other as people do."""

import torch
from torch import Tensor

from conflow.scene.errors import DemonstrationError
from conflow.scene.tasks.curves import MARGIN, distances, ends, some
from conflow.scene.tasks.social_force import Robots, walk
from conflow.scene.tasks.swap import Swap

RARE = 0.01
"""Of what is drawn at least this share has to be kept."""


class Social(Swap):
    """As `Swap`, with other demonstrations."""

    def demonstrations(self, num: int, seed: int) -> Tensor:
        return social(num, self.T, seed, 2 * float(self.robots.radii[0]))


def social(num: int, T: int = 32, seed: int = 0, radius: float = 0.3) -> Tensor:
    """Two robots that swap sides and evade each other by the social-force model, x (num, T, 4) as (x1, y1, x2, y2).

    See `social_force.walk`. Each robot has habits of its own, from indifferent to polite. Both sidestep to the right
    in 65 % of the trajectories and to the left in the others, but in 10 % one of them misunderstands. With the default
    radius about 38 % collide at a waypoint. Drawn again is what comes within MARGIN of `radius`, leaves the workspace
    or does not arrive. The first n of a seed are the same for every num >= n.

    Raises:
        DemonstrationError: nearly all is drawn again, since `radius` is too large.
    """
    generator = torch.Generator().manual_seed(seed)
    x = torch.empty(0, T, 4)
    while len(x) < num:
        drawn, _ = walk(_habits(1000, generator), T, radius)
        inside = (drawn.abs() <= 1).flatten(1).all(dim=1)  # which NaN is not
        clear = (distances(drawn).amin(dim=1) - radius).abs() > MARGIN
        kept = drawn[inside & clear]
        if len(kept) < RARE * len(drawn):
            raise DemonstrationError(f"radius={radius}: {len(kept)} of {len(drawn)} pairs arrive inside, expected less")
        x = torch.cat([x, kept.float()])
    return x[:num]


def _habits(num: int, generator: torch.Generator) -> Robots:
    """Pairs of the robots of `social`."""

    def between(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(num, 2, generator=generator, dtype=torch.float64)

    start, goal = (end.double() for end in ends(num, 0.04, generator))
    side = torch.where(some(0.65, num, generator), -1.0, 1.0)
    understood = torch.where(some(0.9, num, generator), 1.0, -1.0)
    return Robots(
        start,
        goal,
        speed=between(0.45, 1.1),
        drift=between(-0.1, 0.1),
        repulsion=between(0, 10),
        reach=between(0.05, 0.1),
        sidestep=between(1, 5) * torch.stack([side, side * understood], dim=1),
        sight=between(0.3, 0.5),
    )
