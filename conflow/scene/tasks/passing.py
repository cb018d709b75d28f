"""Two robots that swap sides at varying speed, and bulge where they pass."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from conflow.scene.errors import DemonstrationError
from conflow.scene.tasks.curves import MARGIN, distances, ends, harmonics, some, trajectories, uniform
from conflow.scene.tasks.swap import Swap

# Amplitudes of the speed's harmonics in `passing`: a robot's speed stays between 0.2 and 1.8 of its mean.
WARP = (0.3, 0.4, 0.1)


class Passing(Swap):
    """As `Swap`, with other demonstrations."""

    def demonstrations(self, num: int, seed: int) -> Tensor:
        return passing(num, self.T, seed, 2 * float(self.robots.radii[0]))


def passing(num: int, T: int = 32, seed: int = 0, radius: float = 0.3) -> Tensor:
    """Two robots that swap sides at varying speed and bulge where they pass, x (num, T, 4) as (x1, y1, x2, y2).

    A robot goes along its straight line, as in `swap`, with s a smooth monotone function of time, another one for each
    robot. Orthogonal to travel it deviates by +-h b (1 + cos(pi (s - c) / w)) / 2 where |s - c| < w, else by 0: c is
    where the straight lines come closest, w is uniform in [0.25, 0.35], and the robots' shares b, uniform in
    [0.3, 0.7], add up to 1. Of the trajectories 65 % pass on the right, the others on the left.

    h gives the smallest distance over waypoints its distribution: for 60 % uniform in [radius, 1.2 radius], for 40 %,
    which collide, uniform between that of the straight lines and `radius`. All keep MARGIN from `radius`.

    Raises:
        DemonstrationError: straight lines do not collide, since `radius` or T is too small.
    """
    generator = torch.Generator().manual_seed(seed)
    p, q = (end.double() for end in ends(num, 0.04, generator))
    s = warped(num, T, generator)
    straight = trajectories(p, q, s, torch.zeros_like(s))
    closest = distances(straight).min(dim=1)
    c = s.take_along_dim(closest.indices[:, None, None], dim=2)
    w = 0.3 + 0.05 * uniform(generator, num, 2, 1).double()
    share = 0.5 + 0.2 * uniform(generator, num, 1, 1).double() * torch.tensor([[1.0], [-1.0]])
    side = torch.where(some(0.65, num, generator), -1.0, 1.0)[:, None, None]
    # NumPy's cos and sin, here and below: of two threads that share torch's one may be less accurate.
    bump = side * share * (1 + torch.from_numpy(np.cos((torch.pi * ((s - c) / w).clamp(-1, 1)).numpy()))) / 2
    bend = trajectories(p, q, s, bump) - straight

    def bent(h: Tensor) -> Tensor:
        return straight + h[:, None, None] * bend

    wanted = _wanted(closest.values, radius, generator)
    return bent(_bisection(lambda h: distances(bent(h)).amin(dim=1), wanted, 3 * radius)).float()


def warped(num: int, T: int, generator: torch.Generator) -> Tensor:
    """s(t) = t + sum_k a_k sin(k pi t) / (k pi) of both robots, (num, 2, T), with a_k uniform in +-WARP[k-1]."""
    a = uniform(generator, num, 2, len(WARP)).double() * torch.tensor(WARP)
    rate = torch.pi * torch.arange(1, len(WARP) + 1)
    return torch.linspace(0, 1, T, dtype=torch.float64) + (a / rate) @ harmonics(len(WARP), T)


def _wanted(straight: Tensor, radius: float, generator: torch.Generator) -> Tensor:
    """The smallest distances that `passing` promises, (num,), for those of the straight lines, which are below."""
    inside, outside = radius - MARGIN, radius + MARGIN
    if bool((straight >= inside).any()):
        raise DemonstrationError(
            f"radius={radius}: straight lines keep a distance of up to {float(straight.max()):.3f} at waypoints, "
            f"expected less than {inside:.3f}"
        )
    share = torch.rand(len(straight), generator=generator).double()
    collides = some(0.4, len(straight), generator)
    return torch.where(collides, straight + share * (inside - straight), outside + share * (1.2 * radius - outside))


def _bisection(f: Callable[[Tensor], Tensor], wanted: Tensor, high: float) -> Tensor:
    """h (num,) with f(h) = wanted to rounding, for a continuous f with f(0) <= wanted <= f(high)."""
    low, up = torch.zeros_like(wanted), torch.full_like(wanted, high)
    for _ in range(40):
        middle = (low + up) / 2
        below = f(middle) < wanted
        low, up = torch.where(below, middle, low), torch.where(below, up, middle)
    return up
