"""Two arms that swap sides: their demonstrations, and plans in radians and metres."""

import io
import math
import re
import textwrap
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from conflow.errors import ConfigError
from conflow.figures.plans import picture
from conflow.planner import PlanError, Planner
from conflow.scene.arm_constraints import FAR, SphereAvoidance
from conflow.scene.measures import leaves_workspace
from conflow.scene.settings import Ball
from conflow.scene.tasks import ARMS, arms
from conflow.scene.tasks.arms import ArmTask
from conflow.training import config
from conflow.training.build import build_task
from conflow.training.model_file import load_model
from conflow.training.module import Training
from tests.conftest import Command

tasks = pytest.mark.parametrize("name", sorted(ARMS))


@cache
def made(name: str, *arguments: str) -> tuple[ArmTask, Tensor]:
    task = build_task(config.load([f"task={name}", *arguments]))
    assert isinstance(task, ArmTask)
    return task, task.demonstrations(200, seed=0)


@tasks
def test_straight_ways_collide_and_some_that_evade_do_not(name: str) -> None:
    """Arm against arm and nothing else; none at the ends, where arms are far apart."""
    task, x = made(name)
    s = torch.linspace(0, 1, task.T)[:, None]
    kept = task.constraints()
    assert bool(kept["arms"].violation(torch.lerp(x[:, :1], x[:, -1:], s)).all())
    assert 0.3 < kept["arms"].violation(x).float().mean() < 0.6
    assert not any(bool(one.violation(x).any()) for what, one in kept.items() if what != "arms")
    assert not bool(leaves_workspace(x).any())
    assert bool((kept["arms"].clearance(x)[:, [0, -1]] == FAR).all())


@tasks
def test_arms_start_and_end_where_the_task_says(name: str) -> None:
    task, x = made(name)
    q = task.robots.joints(x)
    for end, nominal in zip((0, -1), task.swept, strict=True):
        away = q[:, end].unflatten(1, (2, -1)) - torch.tensor(nominal)
        assert away.abs().max() <= 0.06 + 1e-6  # of rounding to float32
        assert away.abs().max() > 0.055


def test_singles_are_trajectories_of_one_arm_joined_at_random() -> None:
    """Of each arm no more than five, in more pairs than five."""
    _, x = made("planar_arms", "task.singles=5")
    of_each = x.unflatten(2, (2, 4))
    assert [len(of_each[:, :, arm].unique(dim=0)) for arm in (0, 1)] == [5, 5]
    assert len(x.unique(dim=0)) > 15


def test_obstacles_are_known_at_training_or_at_inference_or_never() -> None:
    known = {when: made("pandas", f"task.obstacles={when}")[0] for when in ("training", "inference", "never")}
    assert "obstacle" in known["training"].constraints()
    assert list(known["inference"].constraints_at_inference()) == ["obstacle"]
    assert known["inference"].settings()["obstacle"] == ("obstacle",)
    assert [len(task.judged()) for task in known.values()] == [5, 5, 4]
    assert not known["never"].obstacles()


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("task.obstacles=later", "task pandas: obstacles=later: expected one of training, inference, never"),
        ("task.singles=-1", "task pandas: singles=-1: expected a whole number of at least 0"),
        ("task.lift=2", "task pandas: lift=2: expected a number above 0 and at most 1.0"),
        ("task.apart=0", "task pandas: apart=0: expected a number above 0 and at most 3.0"),
    ],
)
def test_a_setting_of_the_task_that_cannot_be_is_refused_in_one_line(argument: str, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        build_task(config.load(["task=pandas", argument]))
    assert str(refused.value) == said


@cache
def planner(name: str) -> Planner:
    torch.manual_seed(0)
    settings = config.load([f"task={name}", "preset=smoke", "ablation=plus"])
    return Planner(Training(settings, build_task(settings)))


@tasks
def test_plans_are_in_radians_and_metres(name: str) -> None:
    """From start to goal to the last bit; clearances are the constraints' own, in metres, and limits are kept."""
    flow, (task, x) = planner(name), made(name)
    q = task.robots.joints(x[:1, [0, -1]])[0]
    plans = flow.plan(q[0], q[1], num=4)
    assert torch.equal(plans.x[:, 0], q[0].expand(4, -1))
    assert torch.equal(plans.x[:, -1], q[1].expand(4, -1))
    kept = [one.swept_clearance(task.robots.numbers(plans.x)).amin(dim=1) for one in task.constraints().values()]
    # Float32 on the way to radians and back.
    torch.testing.assert_close(plans.clearance, torch.stack(kept).amin(dim=0), rtol=0, atol=1e-5)
    inside = ~leaves_workspace(task.robots.numbers(plans.x))
    assert torch.equal(plans.feasible, (plans.clearance >= 0) & inside)
    low, high = (task.robots.joints(bound * torch.ones(task.robots.D)) for bound in (-1, 1))
    with pytest.raises(PlanError, match=r"^start=.*: expected finite numbers in the workspace [\[(]"):
        flow.plan(high + 0.01, q[1])
    assert bool((low < high).all())


def test_a_planner_is_given_spheres_in_metres() -> None:
    """Judged by them; where one stands in an arm's way at the start, it says so, and a disc is none in space."""
    flow, (task, x) = planner("pandas"), made("pandas")
    start, goal = task.robots.joints(x[0, [0, -1]])
    plans = flow.plan(start, goal, 3, obstacles=[Ball(0.0, 0.0, 0.1, 0.7), (0.0, 0.0, 1.2, 0.05)])
    around = SphereAvoidance(task.robots, [(0.0, 0.0, 0.7, 0.1)])
    assert bool((plans.clearance <= around.swept_clearance(task.robots.numbers(plans.x)).amin(dim=1) + 1e-5).all())
    hand = task.robots.hands(x[:1])[0, 0, 0].tolist()
    with pytest.raises(PlanError, match=r"violates obstacles\[0\] by 0\.\d+ at robot 1"):
        flow.plan(start, goal, 3, obstacles=[(*hand, 0.05)])
    with pytest.raises(PlanError, match=r"^obstacles for arms in 3 dimensions: expected as many numbers of a place$"):
        flow.plan(start, goal, 3, obstacles=[(0.0, 0.0, 0.1)])


def test_the_readme_s_lines_plan_for_two_pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    """With whatever model: this one was not trained."""
    text = (Path(__file__).parents[1] / "README.md").read_text()
    (lines,) = re.findall(r"planner = Planner.load\(.pandas.*?(?=```)", text, re.DOTALL)
    flow = planner("pandas")
    monkeypatch.setattr(Planner, "load", classmethod(lambda cls, run: flow))
    known: dict[str, Any] = {"pi": math.pi, "Planner": Planner}
    exec(lines, known)
    plans = known["plans"]
    assert plans.x.shape == (64, 32, 14)
    assert plans.x[0, 0].tolist() == pytest.approx([-0.8, *known["rest"]] * 2)


def test_another_arm_takes_the_thirty_lines_that_are_shown(conflow: Command, workplace: Path) -> None:
    """Its constants, its spheres and how it evades, as the module of arms has them."""
    assert arms.__doc__ is not None
    lines = textwrap.dedent(arms.__doc__.split("\n\n", 2)[2])
    assert len(lines.splitlines()) <= 30
    (workplace / "three_links.py").write_text(lines)
    result = conflow("train", "task=three_links.py", "ablation=plus", "preset=smoke", "data.num=100")
    assert result.returncode == 0, result.stderr
    assert "violate arms, 0.0% violate self, 0.0% violate speed" in result.stdout


def test_a_run_of_arms_is_loaded_with_its_scales(tmp_path: object) -> None:
    """A scale for each joint goes through the checkpoint."""
    model = planner("pandas").model
    assert isinstance(model, Training)
    checkpoint: dict[str, object] = {"state_dict": model.state_dict()}
    model.on_save_checkpoint(checkpoint)
    path = tmp_path / "model.ckpt"  # type: ignore[operator]
    torch.save(checkpoint, path)
    loaded = load_model(path).task
    assert torch.as_tensor(loaded.scale)[3] == pytest.approx((3.0718 - 0.0698) / 2)
    assert (loaded.length, loaded.origin) == (1.0, (0.0, 0.0))
    assert Planner.load(path).scale[0] == pytest.approx(2.8973)
    assert math.isclose(loaded.dt, 4 / 31)


@tasks
def test_plans_of_arms_are_drawn_with_their_bodies(name: str) -> None:
    """From the front and from above, in the plane from above: every body at five moments, and the obstacle given."""
    flow, (task, x) = planner(name), made(name)
    start, goal = task.robots.joints(x[0, [0, -1]])
    place = (0.0, 0.0, 1.1, 0.05) if task.robots.axes == 3 else (0.0, 1.5, 0.05)
    figure = picture(flow, flow.plan(start, goal, 3, obstacles=[place]), [place])
    assert [axis.get_title() for axis in figure.axes] == (["front", "top"] if task.robots.axes == 3 else ["top"])
    for axis in figure.axes:
        assert sum(len(drawn.get_paths()) for drawn in axis.collections) == 5 * len(task.robots.owner)
        assert len(axis.patches) == 1
        assert len(axis.lines) == 2 * 3 + 2  # both hands' ways in three plans, and the best in bold
    figure.savefig(io.BytesIO())
