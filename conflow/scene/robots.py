"""The robots' geometry: how a configuration places the robots' bodies in the plane."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class PointRobots:
    """Robots whose configuration is their position, one body point each: D = 2 `count`, as (x1, y1, x2, y2, ...)."""

    count: int

    def points(self, x: Tensor) -> Tensor:
        """Body points (batch, T, robots, 1, 2) of configurations x (batch, T, D)."""
        return x.reshape(*x.shape[:2], self.count, 1, 2)

    def pullback(self, g: Tensor) -> Tensor:
        """Gradient with respect to configurations, (batch, T, D), of one with respect to body points."""
        return g.flatten(2)
