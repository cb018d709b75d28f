"""What a task brings, what a constraint has without writing it, and closed forms beside what they override."""

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
import torch
from torch import Tensor

from conflow.errors import ConfigError
from conflow.scene.constraint import (
    AccelerationLimit,
    Barrier,
    Constraint,
    ObstacleAvoidance,
    RobotAvoidance,
    SpeedLimit,
    Sum,
    Workspace,
)
from conflow.scene.robots import Discs, Robots
from conflow.scene.settings import Obstacle
from conflow.scene.task import Task
from conflow.training.build import task_of_file

DISCS = Discs(3, radius=[0.05, 0.1, 0.2])
OBSTACLES = [Obstacle(0.0, 0.5, 0.1), Obstacle(-0.4, 0.0, 0.2)]


class Corridor(Constraint):
    """A user's: a clearance alone."""

    def clearance(self, x: Tensor) -> Tensor:
        return 0.4 - self.robots.points(x)[..., 1].abs().amax(dim=2)


CLOSED: dict[str, Callable[[], Constraint]] = {
    "robots": lambda: RobotAvoidance(DISCS),
    "obstacles": lambda: ObstacleAvoidance(DISCS, OBSTACLES),
    "walls": lambda: Workspace(DISCS),
}
ALL = CLOSED | {
    "corridor": lambda: Corridor(DISCS),
    "sum": lambda: Sum([RobotAvoidance(DISCS), Corridor(DISCS)]),
    "speed": lambda: SpeedLimit(DISCS, 1.0, 0.1),
    "acceleration": lambda: AccelerationLimit(DISCS, 5.0, 0.1),
}


def trajectories(seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return 0.8 * torch.randn(40, 7, 6, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("name", CLOSED)
@pytest.mark.parametrize("pairs", ["nearest", "all"])
def test_each_closed_gradient_is_that_of_automatic_differentiation(name: str, pairs: str) -> None:
    shape = Barrier(gamma=7.0, pairs=pairs)  # type: ignore[arg-type]  # one of its kinds
    constraint, x = CLOSED[name]().shaped(shape), trajectories()
    c, pullback = constraint.vjp(x)
    default_c, default = Constraint.vjp(constraint, x)
    g = torch.rand(c.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
    torch.testing.assert_close(c, default_c)
    torch.testing.assert_close(pullback(g), default(g))
    x.requires_grad_()
    (numeric,) = torch.autograd.grad(constraint.barrier(x).sum(), x)
    torch.testing.assert_close(constraint.gradient(x.detach()), numeric)


@pytest.mark.parametrize("name", CLOSED)
def test_each_closed_swept_clearance_is_what_subdivision_tends_to(name: str) -> None:
    """From below; between two of eight points a body that moves by m is at most m / 16 nearer."""
    constraint, x = CLOSED[name](), trajectories()
    exact, divided = constraint.swept_clearance(x), Constraint.swept_clearance(constraint, x)
    assert bool((exact <= divided + 1e-12).all())
    steps = DISCS.points(x).diff(dim=1).norm(dim=3)
    # The separation of two bodies changes by both of their ways.
    assert bool((divided - exact <= 2 * steps.amax(dim=2) / 16 + 1e-12).all())


@pytest.mark.parametrize("name", ALL)
def test_a_margin_takes_as_much_off_every_clearance(name: str) -> None:
    constraint, x = ALL[name](), trajectories()
    narrow = constraint.shaped(Barrier("relu"), margin=0.07)
    torch.testing.assert_close(narrow.clearance(x), constraint.clearance(x) - 0.07, rtol=0, atol=1e-6)  # float32 radii
    torch.testing.assert_close(narrow.swept_clearance(x), constraint.swept_clearance(x) - 0.07, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ALL)
def test_the_swept_clearance_is_never_above_that_of_the_waypoints(name: str) -> None:
    constraint, x = ALL[name](), trajectories()
    c, swept = constraint.clearance(x), constraint.swept_clearance(x)
    assert c.shape == (40, 7)
    assert swept.shape == (40, 6)
    if name != "speed":  # at a waypoint the faster of two steps counts, so there a step has more room
        assert bool((swept <= torch.minimum(c[:, :-1], c[:, 1:]) + 1e-9).all())


@pytest.mark.parametrize("name", ALL)
def test_every_constraint_has_barrier_and_gradient(name: str) -> None:
    constraint, x = ALL[name]().shaped(Barrier(gamma=5.0)), trajectories()
    x.requires_grad_()
    (numeric,) = torch.autograd.grad(constraint.barrier(x).sum(), x)
    found = constraint.gradient(x.detach())
    assert bool(found.isfinite().all())
    torch.testing.assert_close(found, numeric)
    assert torch.equal(constraint.violation(x), ~(constraint.clearance(x).amin(dim=1) >= 0))


def test_discs_of_their_own_radii_touch_at_the_sum_of_both() -> None:
    """On the x-axis at 0, 0.5 and 1.5: gaps of 0.5 - 0.15, 1 - 0.3 and 1.5 - 0.25."""
    x = torch.tensor([[[0.0, 0.0, 0.5, 0.0, 1.5, 0.0]]])
    torch.testing.assert_close(RobotAvoidance(DISCS).clearances(x)[0, 0], torch.tensor([0.35, 1.25, 0.7]))


def test_all_pairs_count_as_the_sum_of_each() -> None:
    """C with pairs=all is the sum over pairs of C of two robots alone."""
    x, shape = trajectories(), Barrier(gamma=7.0, pairs="all")
    each = [
        RobotAvoidance(Discs(2, DISCS.radii[[i, j]].tolist()))
        .shaped(Barrier(gamma=7.0))
        .barrier(torch.cat([x[..., 2 * i : 2 * i + 2], x[..., 2 * j : 2 * j + 2]], dim=2))
        for i, j in ((0, 1), (0, 2), (1, 2))
    ]
    # The radii are added in single precision there and here.
    torch.testing.assert_close(RobotAvoidance(DISCS).shaped(shape).barrier(x), sum(each), rtol=1e-5, atol=1e-5)


def test_speed_and_acceleration_are_those_of_known_motions() -> None:
    """p = 0.5 a t^2 at steps of dt: speed (k + 1/2) a dt in step k, acceleration a throughout."""
    dt, a = 0.1, 2.0
    t = dt * torch.arange(6, dtype=torch.float64)
    x = torch.stack([0.5 * a * t**2, torch.zeros(6)], dim=1)[None]
    one = Discs(1)
    speeds = a * dt * (torch.arange(5, dtype=torch.float64) + 0.5)
    torch.testing.assert_close(SpeedLimit(one, 1.0, dt).swept_clearance(x)[0], 1 - speeds)
    torch.testing.assert_close(SpeedLimit(one, 1.0, dt).clearance(x)[0], 1 - speeds[[0, 1, 2, 3, 4, 4]])
    torch.testing.assert_close(AccelerationLimit(one, 3.0, dt).clearance(x)[0], torch.ones(6, dtype=torch.float64))


@pytest.mark.parametrize("name", ["speed", "acceleration"])
def test_a_robot_that_stands_still_has_a_finite_gradient(name: str) -> None:
    assert bool(ALL[name]().gradient(torch.zeros(1, 7, 6)).isfinite().all())


def test_one_robot_is_allowed_but_has_nobody_to_avoid() -> None:
    one, x = Discs(1, 0.1), trajectories()[..., :2]
    for constraint in (Workspace(one), ObstacleAvoidance(one, OBSTACLES), SpeedLimit(one, 1.0, 0.1)):
        assert constraint.gradient(x).shape == x.shape
    with pytest.raises(ValueError, match="one robot: expected two or more that avoid each other"):
        RobotAvoidance(one)


class Moving(Task):
    """Two constraints in training, one at inference."""

    robots: Robots = Discs(2)
    T, seconds = 11, 5.0

    def constraints(self) -> Mapping[str, Constraint]:
        return {"robot": RobotAvoidance(self.robots), "corridor": Corridor(self.robots)}

    def constraints_at_inference(self) -> Mapping[str, Constraint]:
        return {"object": ObstacleAvoidance(self.robots, OBSTACLES)}

    def demonstrations(self, num: int, seed: int) -> Tensor:
        return torch.zeros(num, self.T, 4)


def test_a_task_says_by_itself_what_follows_from_the_rest() -> None:
    task = Moving()
    assert (task.name, task.dt) == ("moving", 0.5)
    assert task.settings() == {"all": ("robot", "corridor"), "object": ("object",)}
    assert list(task.judged()) == ["robot", "corridor", "object"]


COMPLETE = """
import torch, conflow
class Mine(conflow.Task):
    robots = conflow.Discs(1)
    def constraints(self): return {"walls": conflow.Workspace(self.robots)}
    def demonstrations(self, num, seed): return torch.zeros(num, 32, 2)
"""


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("x = 1\n", "expected one class that is a conflow.Task, found none"),
        (COMPLETE + "class Other(Mine): pass\n", "expected one class that is a conflow.Task, found Mine, Other"),
        ("raise RuntimeError('not\\ntoday')\n", "RuntimeError: not today"),
        ("def f(:\n", "SyntaxError"),
        ("import conflow\nclass Mine(conflow.Task): pass\n", "expected Mine to define constraints, demonstrations"),
        (COMPLETE.replace("    robots = conflow.Discs(1)\n", ""), "robots"),
        (COMPLETE.replace('{"walls": conflow.Workspace(self.robots)}', "{}"), "expected a constraint in constraints()"),
        (COMPLETE + '    def settings(self): return {"a": ("b",)}\n', "setting a guides around b, expected names of"),
    ],
    ids=["none", "two", "fails", "syntax", "abstract", "no robots", "no constraint", "unknown constraint"],
)
def test_a_file_without_a_task_is_refused_in_one_line(
    content: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("mine.py")
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"^task=mine\.py: ") as refused:
        task_of_file(path)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_with_a_task_gives_it(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(COMPLETE)
    assert task_of_file(tmp_path / "mine.py").name == "mine"
    with pytest.raises(ConfigError, match="no such file"):
        task_of_file(tmp_path / "other.py")
