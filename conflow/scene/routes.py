"""Ways of single robots through a map: the cheapest on a grid whose costs differ by chance, so that ways differ too."""

import math
from collections.abc import Sequence
from functools import reduce

import torch
import torch.nn.functional as F
from torch import Tensor

from conflow.scene.crowd import MapAvoidance
from conflow.scene.robots import Crowd
from conflow.scene.settings import Box

CELLS = 41
SIDE = 2 / (CELLS - 1)
"""Of the grid: along an axis, and from one to the next."""
VARIETY, PATCHES = 0.5, 6
"""Standard deviation of the logarithm of costs, and how many independent ones there are along an axis."""
DEARER, NEAR = 3.0, 0.05
"""How much more a step costs beside a box, and within which distance that falls by e."""
HURRY = 0.3
"""Largest share of its speed by which each of three sinusoids makes a robot slower or faster on its way."""
SMOOTHINGS = 16
"""Averages of a waypoint with its neighbours, which round the corners of the grid."""

STRAIGHT, DIAGONAL = ((-1, 0), (0, -1), (0, 1), (1, 0)), ((-1, -1), (-1, 1), (1, -1), (1, 1))
"""From a cell to its neighbours."""


def routes(p: Tensor, q: Tensor, boxes: Sequence[Box], radius: float, T: int, generator: torch.Generator) -> Tensor:
    """A trajectory of each robot from p to q, both (n, 2), clear of the boxes where the grid has a way, (n, T, 2).

    Where it has none the trajectory goes straight.
    """
    line = torch.linspace(-1, 1, CELLS)
    cells = torch.cartesian_prod(line, line)
    clearance = _clearance(cells, boxes, radius).view(CELLS, CELLS)
    cost = costs(clearance, len(p), generator)
    free = torch.where(clearance < 0, torch.inf, 0).flatten()
    start, goal = (((end[:, None] - cells).square().sum(dim=2) + free).argmin(dim=1) for end in (p, q))
    way = line[walk(cost, cost_to_go(cost, goal), start)]
    way = torch.cat([p[:, None], way[:, 1:-1], q[:, None]], dim=1)
    return smoothed(along(way, warped(len(p), T, generator)))


def _clearance(points: Tensor, boxes: Sequence[Box], radius: float) -> Tensor:
    """Of a robot at points (n, 2), (n,)."""
    return MapAvoidance(Crowd(1, radius), boxes).clearance(points[:, None]).squeeze(1)


def costs(clearance: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """What a unit of way costs each robot at every cell, (count, CELLS, CELLS); inf where the clearance is negative.

    exp(VARIETY z) (1 + DEARER exp(-clearance / NEAR)) with z smooth, and about standard normal.
    """
    z = torch.randn(count, 1, PATCHES, PATCHES, generator=generator)
    z = F.interpolate(z, size=clearance.shape, mode="bicubic", align_corners=True).squeeze(1)
    cost = torch.exp(VARIETY * z) * (1 + DEARER * torch.exp(-clearance / NEAR))
    return torch.where(clearance < 0, torch.inf, cost)


def cost_to_go(cost: Tensor, goal: Tensor) -> Tensor:
    """V = min over neighbours of (length of the step x cost here + V there), and 0 at the goal: (n, CELLS, CELLS).

    Value iteration, of all robots at once, until nothing changes.

    Args:
        cost: of a unit of way, (n, CELLS, CELLS).
        goal: cells, numbered row by row, (n,).
    """
    V = torch.full_like(cost, torch.inf)
    V.flatten(1).scatter_(1, goal[:, None], 0)
    straight, diagonal = SIDE * cost, math.sqrt(2) * SIDE * cost
    while True:
        sides, corners = (reduce(torch.minimum, _beside(V, steps)) for steps in (STRAIGHT, DIAGONAL))
        before, V = V, torch.minimum(V, torch.minimum(straight + sides, diagonal + corners))
        if torch.equal(V, before):
            return V


def _beside(V: Tensor, steps: Sequence[tuple[int, int]]) -> list[Tensor]:
    """V of the neighbours so many steps away, each (n, rows, columns); inf beyond the border."""
    rows, columns = V.shape[1:]
    around = F.pad(V, (1, 1, 1, 1), value=torch.inf)
    return [around[:, 1 + i : 1 + i + rows, 1 + j : 1 + j + columns] for i, j in steps]


def walk(cost: Tensor, V: Tensor, start: Tensor) -> Tensor:
    """Cells (row, column) from start (n,) to where V is 0, (n, steps, 2); who arrives waits, and who cannot leave."""
    columns, steps = V.shape[2], STRAIGHT + DIAGONAL
    lengths = SIDE * torch.tensor(steps).double().norm(dim=1).float()
    through = torch.stack(_beside(V, steps), dim=1) + lengths[:, None, None] * cost[:, None]
    hops = torch.tensor([columns * i + j for i, j in steps])[through.argmin(dim=1)]
    hops = torch.where((V == 0) | V.isinf(), 0, hops).flatten(1)
    way = [start]
    while bool((hop := hops.gather(1, way[-1][:, None])[:, 0]).any()):
        way.append(way[-1] + hop)
    cells = torch.stack(way, dim=1)
    return torch.stack([cells // columns, cells % columns], dim=2)


def warped(count: int, T: int, generator: torch.Generator) -> Tensor:
    """The share of its way that each robot has gone at every waypoint, (count, T), from 0 to 1.

    s + sum_k c_k sin(k pi s) / (k pi) for k = 1, 2, 3 with c_k uniform in +-HURRY: robots never turn back.
    """
    s, k = torch.linspace(0, 1, T), torch.arange(1, 4)
    c = HURRY * (2 * torch.rand(count, 3, generator=generator) - 1)
    gone = s + (c / (math.pi * k)) @ torch.sin(math.pi * k[:, None] * s)
    gone[:, -1] = 1
    return gone


def along(way: Tensor, gone: Tensor) -> Tensor:
    """The points of polylines (n, steps, 2) at shares (n, T) of their length, (n, T, 2)."""
    length = F.pad(torch.linalg.vector_norm(way.diff(dim=1), dim=2).cumsum(dim=1), (1, 0))
    wanted = gone * length[:, -1:]
    i = torch.searchsorted(length, wanted).clamp(1, length.shape[1] - 1)
    low, high = length.gather(1, i - 1), length.gather(1, i)
    p, q = (way.take_along_dim(k[..., None], dim=1) for k in (i - 1, i))
    share = ((wanted - low) / (high - low).clamp_min(torch.finfo(low.dtype).tiny)).clamp(0, 1)
    return torch.lerp(p, q, share[..., None])


def smoothed(x: Tensor) -> Tensor:
    """Every waypoint but the ends averaged with its neighbours (1/4, 1/2, 1/4), SMOOTHINGS times, (n, T, 2)."""
    T = x.shape[1]
    average = torch.eye(T) / 2 + (torch.eye(T).roll(1, dims=0) + torch.eye(T).roll(-1, dims=0)) / 4
    average[[0, -1]] = torch.eye(T)[[0, -1]]
    y = torch.linalg.matrix_power(average, SMOOTHINGS) @ x
    y[:, [0, -1]] = x[:, [0, -1]]  # to the last bit
    return y
