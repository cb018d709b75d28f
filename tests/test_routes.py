"""Ways of single robots through a map: value iteration, the walk along it, and what becomes of it in time."""

import math

import pytest
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from conflow.scene.crowd import MapAvoidance
from conflow.scene.robots import Crowd
from conflow.scene.routes import (
    CELLS,
    HURRY,
    SIDE,
    SMOOTHINGS,
    along,
    cost_to_go,
    costs,
    routes,
    smoothed,
    walk,
    warped,
)
from conflow.scene.settings import Box

WALL = [Box(0.0, -0.2, width=0.2, height=1.6)]
"""Open above alone, where the way from left to right goes."""


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def a_map(seed: int) -> Tensor:
    """Costs of one robot where a fifth of the cells are blocked, (1, CELLS, CELLS)."""
    blocked = torch.rand(CELLS, CELLS, generator=seeded(seed)) < 0.2
    return costs(torch.where(blocked, -0.01, 0.1), 1, seeded(seed))


def graph(cost: Tensor) -> csr_array:
    """The same grid as a graph: an edge from every free cell to its neighbours."""
    edges, weights = [], []
    for i, j in (cost < torch.inf).nonzero().tolist():
        for di, dj in ((a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b):
            if 0 <= i + di < CELLS and 0 <= j + dj < CELLS:
                edges.append((i * CELLS + j, (i + di) * CELLS + j + dj))
                weights.append(SIDE * math.hypot(di, dj) * float(cost[i, j]))
    rows, columns = zip(*edges, strict=True)
    return csr_array((weights, (rows, columns)), shape=(CELLS**2, CELLS**2))


@pytest.mark.parametrize("seed", [0, 1])
def test_value_iteration_finds_what_dijkstra_finds(seed: int) -> None:
    cost = a_map(seed)
    goal = int((cost.flatten() < torch.inf).nonzero()[100])
    expected = dijkstra(graph(cost[0]).T, indices=goal)
    found = cost_to_go(cost, torch.tensor([goal])).flatten().double()
    torch.testing.assert_close(found, torch.from_numpy(expected), rtol=1e-5, atol=0)  # in float32


def test_a_walk_costs_what_was_to_go() -> None:
    cost = a_map(2).expand(50, -1, -1)
    free = (cost[0].flatten() < torch.inf).nonzero()[:, 0]
    start, goal = free[torch.randint(len(free), (2, 50), generator=seeded())]
    V = cost_to_go(cost, goal)
    reachable = V.flatten(1).gather(1, start[:, None])[:, 0] < torch.inf
    assert int(reachable.sum()) > 40
    way = walk(cost, V, start)
    assert torch.equal(way[:, 0], torch.stack([start // CELLS, start % CELLS], dim=1))
    assert torch.equal(way[reachable, -1], torch.stack([goal // CELLS, goal % CELLS], dim=1)[reachable])
    steps = way.diff(dim=1)
    assert int(steps.abs().max()) == 1
    lengths = SIDE * steps.double().norm(dim=2)
    spent = (lengths * cost[0][way[:, :-1, 0], way[:, :-1, 1]].nan_to_num(posinf=0)).sum(dim=1)
    to_go = V.flatten(1).gather(1, start[:, None])[:, 0].double()
    torch.testing.assert_close(spent[reachable], to_go[reachable], rtol=1e-5, atol=1e-5)
    assert not steps[~reachable].any()


def test_a_way_goes_around_a_wall_and_meets_its_ends() -> None:
    p = torch.tensor([[-0.5, -0.8]]).expand(40, -1)
    q = torch.tensor([[0.5, -0.8]]).expand(40, -1)
    x = routes(p, q, WALL, 0.05, 64, seeded())
    assert torch.equal(x[:, 0], p)
    assert torch.equal(x[:, -1], q)
    assert float(MapAvoidance(Crowd(1, 0.05), WALL).swept_clearance(x).min()) >= 0
    # Up to the wall's upper end at 0.6, and down again; the grid and costs by chance lead a little astray.
    length = x.diff(dim=1).norm(dim=2).sum(dim=1)
    shortest = 2 * math.hypot(0.35, 1.4) + 0.3
    assert float(length.min()) > shortest
    assert float(length.median()) < 1.25 * shortest
    assert float(x.std(dim=0).max()) > 0.02


def test_where_there_is_no_way_a_trajectory_goes_straight() -> None:
    closed = [Box(0.0, 0.0, width=0.2, height=4.0)]
    p, q = torch.tensor([[-0.5, 0.3]]), torch.tensor([[0.5, 0.3]])
    x = routes(p, q, closed, 0.05, 64, seeded())
    torch.testing.assert_close(x[..., 1], torch.full((1, 64), 0.3))
    assert torch.equal(x[:, [0, -1], 0], torch.tensor([[-0.5, 0.5]]))


def test_robots_hurry_and_linger_but_never_turn_back() -> None:
    gone = warped(2000, 64, seeded())
    assert torch.equal(gone[:, [0, -1]], torch.tensor([0.0, 1.0]).expand(2000, -1))
    speed = 63 * gone.diff(dim=1)
    assert float(speed.min()) > 0
    assert 1 - 3 * HURRY < float(speed.min()) < 1 - 2 * HURRY
    assert 1 + 2 * HURRY < float(speed.max()) < 1 + 3 * HURRY


def test_shares_of_a_polyline_are_of_its_length() -> None:
    """On a polyline with a corner and a rest at its end."""
    way = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 3.0], [1.0, 3.0]]])
    x = along(way, torch.tensor([[0.0, 0.125, 0.25, 0.5, 1.0]]))
    torch.testing.assert_close(x, torch.tensor([[[0.0, 0.0], [0.5, 0.0], [1.0, 0.0], [1.0, 1.0], [1.0, 3.0]]]))


def test_smoothing_leaves_straight_lines_and_ends_and_rounds_corners() -> None:
    s = torch.linspace(0, 1, 64)
    straight = torch.stack([s, 2 * s], dim=1)[None]
    torch.testing.assert_close(smoothed(straight), straight)
    corner = torch.stack([s, (s - s[32]).clamp(min=0)], dim=1)[None]
    y = smoothed(corner)
    assert torch.equal(y[:, [0, -1]], corner[:, [0, -1]])
    # The second difference, at one waypoint alone before, is spread like a binomial distribution.
    sharpest = (z.diff(n=2, dim=1).norm(dim=2).max() for z in (y, corner))
    after, before = map(float, sharpest)
    assert after / before == pytest.approx(math.comb(2 * SMOOTHINGS, SMOOTHINGS) / 4**SMOOTHINGS, rel=1e-3)
