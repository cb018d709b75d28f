"""Constraints on a crowd: discs of one radius, as many as trajectories have, among each other and in a map."""

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from conflow.scene.constraint import Constraint, PairAvoidance, Pullback
from conflow.scene.robots import Crowd
from conflow.scene.settings import Box

TOGETHER = 6000
"""Pairs of discs, of all trajectories together, whose gradients are computed at a time."""


class CrowdAvoidance(PairAvoidance):
    """No disc of a crowd touches another: c_ij = |p_i - p_j| - 2 r, one clearance for every pair.

    As `RobotAvoidance`, for any number of discs.

    >>> x = torch.tensor([[[0.0, 0.0, 0.5, 0.0, 0.0, 1.0]]])  # three discs
    >>> CrowdAvoidance(Crowd(10, radius=0.125)).clearances(x)
    tensor([[[0.2500, 0.7500, 0.8680]]])

    Args:
        robots: the crowd.
        margin: that is kept beyond touching.
    """

    robots: Crowd

    def __init__(self, robots: Crowd, margin: float = 0.0) -> None:
        super().__init__(robots)
        self.margin = margin

    def separations(self, x: Tensor) -> Tensor:
        i, j, _ = _pairs_of(x.shape[2] // 2)
        p = self.robots.points(x).permute(2, 3, 0, 1).contiguous()
        return p[i] - p[j]

    def onto_bodies(self, dC_dw: Tensor) -> Tensor:
        # Of n discs there are n (n - 1) / 2 pairs.
        count = (1 + math.isqrt(1 + 8 * len(dC_dw))) // 2
        incidence = _pairs_of(count)[2].to(dC_dw)
        return (incidence.mT @ dC_dw.flatten(1)).view(count, *dC_dw.shape[1:])

    def gaps(self, d: Tensor) -> Tensor:
        return d - (2 * self.robots.radius + self.margin)

    def gradient(self, x: Tensor) -> Tensor:
        # In pieces that a processor's cache holds; each step on the whole would ask the system for memory anew.
        gradient, count = super().gradient, x.shape[2] // 2
        rows = max(1, TOGETHER // max(1, count * (count - 1) // 2))
        return torch.cat([gradient(piece) for piece in x.split(rows)])

    def narrowed(self, margin: float) -> Constraint:
        made = CrowdAvoidance(self.robots, self.margin + margin)
        made.shape = self.shape
        return made


@lru_cache(maxsize=64)
def _pairs_of(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs i < j of so many discs, (pairs,) each, and their incidence: 1 at i, -1 at j, (pairs, count)."""
    i, j = torch.triu_indices(count, count, 1)
    unit = torch.eye(count)
    return i, j, unit[i] - unit[j]


class MapAvoidance(Constraint):
    """Every disc of a crowd stays clear of rounded boxes; a disc of radius r is the square 2 r rounded by r.

    With q = |p - centre| - (size / 2 - rounding), the distance of p to a box is |max(q, 0)| + min(max(q_x, q_y), 0) -
    rounding, negative inside: exact everywhere.

    >>> x = torch.tensor([[[0.0, 1.0]]])  # one disc, above a box
    >>> MapAvoidance(Crowd(1, radius=0.25), [Box(0.0, 0.0, width=2.0, height=0.5)]).clearance(x).item()
    0.5

    Args:
        robots: the crowd.
        boxes: one or more.
        margin: that is kept beyond touching.
    """

    robots: Crowd
    centre: Tensor
    core: Tensor
    rounding: Tensor

    def __init__(self, robots: Crowd, boxes: Sequence[Box], margin: float = 0.0) -> None:
        super().__init__(robots)
        self.boxes, self.margin = boxes, margin
        self.register_buffer("centre", torch.tensor([[box.x, box.y] for box in boxes]), persistent=False)
        core = torch.tensor([[box.width / 2 - box.rounding, box.height / 2 - box.rounding] for box in boxes])
        self.register_buffer("core", core, persistent=False)
        self.register_buffer("rounding", torch.tensor([box.rounding for box in boxes]), persistent=False)

    def clearance(self, x: Tensor) -> Tensor:
        return self.clearances(x).amin(dim=2)

    def clearances(self, x: Tensor) -> Tensor:
        return self._arranged(self._distances(*self._beyond(x)[2:]))

    def vjp(self, x: Tensor) -> tuple[Tensor, Pullback]:
        away_x, away_y, q_x, q_y = self._beyond(x)
        out_x, out_y = q_x.clamp(min=0), q_y.clamp(min=0)
        length = (out_x * out_x + out_y * out_y).sqrt()
        # Outside, away from the nearest point; inside, straight out through the nearest side.
        inside, sideways = length == 0, q_x >= q_y
        u_x = torch.where(inside, sideways.to(x.dtype), out_x / length) * away_x.sign()
        u_y = torch.where(inside, (~sideways).to(x.dtype), out_y / length) * away_y.sign()

        def pullback(g: Tensor) -> Tensor:
            g = g.unflatten(2, u_x.shape[:2]).permute(2, 3, 0, 1)
            dC_dp = torch.stack([(g * u_x).sum(dim=0), (g * u_y).sum(dim=0)], dim=1)
            return dC_dp.permute(2, 3, 0, 1).flatten(2)

        return self._arranged(self._distances(q_x, q_y)), pullback

    def narrowed(self, margin: float) -> Constraint:
        made = MapAvoidance(self.robots, self.boxes, self.margin + margin)
        made.shape = self.shape
        return made

    def _beyond(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """p - centre and q, both by axis, (boxes, discs, batch, T): whole blocks, as in `CrowdAvoidance`."""
        p = self.robots.points(x).permute(3, 2, 0, 1).contiguous()
        centre, core = (values.to(x).T[:, :, None, None, None] for values in (self.centre, self.core))
        away_x, away_y = p[:, None] - centre
        return away_x, away_y, away_x.abs() - core[0], away_y.abs() - core[1]

    def _distances(self, q_x: Tensor, q_y: Tensor) -> Tensor:
        """Clearances, (boxes, discs, batch, T)."""
        out_x, out_y = q_x.clamp(min=0), q_y.clamp(min=0)
        outside, inside = (out_x * out_x + out_y * out_y).sqrt(), torch.maximum(q_x, q_y).clamp(max=0)
        kept = self.rounding.to(q_x) + (self.robots.radius + self.margin)
        return outside + inside - kept[:, None, None, None]

    def _arranged(self, c: Tensor) -> Tensor:
        """The same as (batch, T, boxes discs)."""
        return c.flatten(0, 1).permute(1, 2, 0)
