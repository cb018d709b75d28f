"""The robots' geometry: how a configuration places the robots' bodies in the workspace."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor


class Robots(ABC):
    """One robot or more, each made of bodies: discs in the plane, or spheres in space.

    A configuration is D numbers, of whatever kind: positions, or the joints of arms.

    Attributes:
        D: numbers of a configuration.
        radii: of the bodies, float64 (bodies,), in workspace units.
        owner: to which robot each body belongs, (bodies,).
    """

    D: int
    radii: Tensor
    owner: Tensor

    @property
    def count(self) -> int:
        """How many robots there are."""
        return int(self.owner.max()) + 1

    @property
    def traced(self) -> Sequence[int]:
        """The bodies whose paths pictures draw: here all."""
        return range(len(self.owner))

    @abstractmethod
    def points(self, x: Tensor) -> Tensor:
        """The bodies' centres, (batch, T, bodies, 2 or 3), of configurations x (batch, T, D)."""

    @abstractmethod
    def pullback(self, x: Tensor, g: Tensor) -> Tensor:
        """The gradient with respect to configurations x, (batch, T, D), of one g with respect to `points(x)`."""

    def moved(self, g: Tensor) -> Tensor:
        """Which bodies a change g (batch, T, D) of the configuration moves, boolean (batch, T, bodies); here all."""
        return torch.ones(*g.shape[:2], len(self.owner), dtype=torch.bool, device=g.device)


class Discs(Robots):
    """Discs in the plane whose configuration is their position: D = 2 count, as (x1, y1, x2, y2, ...).

    >>> Discs(2, radius=0.15).points(torch.zeros(5, 32, 4)).shape
    torch.Size([5, 32, 2, 2])

    Args:
        count: how many.
        radius: of all of them, or of each.
    """

    def __init__(self, count: int, radius: float | Sequence[float] = 0.15) -> None:
        radii = torch.as_tensor(radius, dtype=torch.float64)
        if count < 1 or radii.shape not in ((), (count,)) or not bool((radii >= 0).all()):
            raise ValueError(f"{count} discs of radius {radius}: expected one or more, with a radius for all or each")
        self.D, self.radii, self.owner = 2 * count, radii.expand(count), torch.arange(count)

    @classmethod
    def of(cls, D: int, radius: float) -> "Discs":
        """As many as D numbers place in the plane."""
        return cls(D // 2, radius)

    def points(self, x: Tensor) -> Tensor:
        return x.unflatten(2, (-1, 2))

    def pullback(self, x: Tensor, g: Tensor) -> Tensor:
        return g.flatten(2)

    def moved(self, g: Tensor) -> Tensor:
        return g.unflatten(2, (-1, 2)).any(dim=3)

    def apart(self, x: Tensor) -> Tensor:
        """The gap between every two discs at every waypoint of x (batch, T, D), (batch, T, count, count)."""
        p, radii = self.points(x).movedim(3, 0), self.radii.to(x)
        w_x, w_y = p[..., None] - p[..., None, :]
        return (w_x * w_x + w_y * w_y).sqrt() - (radii[:, None] + radii)


class Crowd(Discs):
    """Discs of one radius, as many as a configuration has numbers for: D = 2 for each that is there.

    `count` and D are of the most that a task has. What does not ask for them takes any number.

    Args:
        count: how many there are at most.
        radius: of all of them.
    """

    def __init__(self, count: int, radius: float) -> None:
        super().__init__(count, radius)
        self.radius = radius

    def apart(self, x: Tensor) -> Tensor:
        return Discs.apart(self, x) if x.shape[2] == self.D else Crowd(x.shape[2] // 2, self.radius).apart(x)
