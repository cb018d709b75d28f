"""What the pictures show, read back from them and compared with numbers computed another way."""

import json
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.text import Text
from mlflow.entities import Run
from rich.console import Console
from torch import Tensor

from conflow.figures import curves, gallery, workspace
from conflow.figures.animation import animation, frames, gaps
from conflow.flow.sampler import integrate
from conflow.scene.constraint import Constraint, ObstacleAvoidance, RobotAvoidance, SpeedLimit, Sum
from conflow.scene.crowd import CrowdAvoidance
from conflow.scene.measures import smoothness
from conflow.scene.robots import Crowd, Discs
from conflow.scene.settings import Obstacle
from conflow.scene.task import Task
from conflow.tracking import recording, store
from conflow.training import config
from conflow.training.datamodule import DemonstrationData
from conflow.training.diagnostics import guidance
from conflow.training.evaluation import Evaluation, cycle
from conflow.training.metrics import wilson
from conflow.training.model import ConFlow
from conflow.training.module import Training
from conflow.training.reload import demonstrations
from conflow.training.train import experiment
from tests.conftest import Command
from tests.papers import SETTINGS, TWO, model_of


def model(*arguments: str) -> Training:
    torch.manual_seed(0)
    return model_of(config.load(["preset=smoke", *arguments]), 32, 4)


@pytest.fixture(scope="module")
def data() -> DemonstrationData:
    return DemonstrationData(config.load(["preset=smoke"]))


@pytest.fixture(scope="module")
def evaluation(data: DemonstrationData) -> Evaluation:
    """Samples of an untrained model: those of the source, about, of which some collide."""
    return gallery.sample(model("sample.robot_weight=2"), cycle(data.test.x, 512))


def lines(axis: Axes) -> Tensor:
    """The trajectories drawn on an axis, (robots * shown, T, 2)."""
    drawn = [c.get_segments() for c in axis.collections if isinstance(c, LineCollection)]
    return torch.tensor([segment.tolist() for segments in drawn for segment in segments])


def marks(axis: Axes) -> Tensor:
    """Where collisions are marked, (number, 2)."""
    *_, crosses = (c for c in axis.collections if isinstance(c, PathCollection))
    return torch.tensor(np.array(crosses.get_offsets()), dtype=torch.float32)


def curve(axis: Axes, label: str) -> tuple[list[float], list[float]]:
    (line,) = [line for line in axis.lines if line.get_label() == label]
    return np.array(line.get_xdata()).tolist(), np.array(line.get_ydata()).tolist()


def sort(x: Tensor) -> Tensor:
    """Rows in an order that does not depend on the one they came in."""
    return torch.tensor(sorted(x.flatten(1).tolist()))


def distance(x: Tensor) -> Tensor:
    return (x[..., :2] - x[..., 2:]).norm(dim=-1)


def test_demonstrations_are_drawn_apart_by_their_label(data: DemonstrationData) -> None:
    feasible, colliding = workspace.demonstrations(data).axes
    for axis, violates in ((feasible, False), (colliding, True)):
        x = data.x[data.violates == violates]
        assert axis.get_title().endswith(f": {len(x)} of {len(data.x)}")
        shown = x[: workspace.SHOWN].unflatten(2, (2, 2)).transpose(1, 2).flatten(0, 1)
        assert torch.equal(sort(lines(axis)), sort(shown))
    assert len(marks(feasible)) == 0


def test_a_collision_is_marked_between_the_robots_that_collide() -> None:
    """Of three robots the second and the third, at the waypoint where they are closest."""
    flow = model_of(config.load(["preset=smoke"]), 5, 6)
    x = torch.tensor([-0.9, 0.9, 0.3, 0.0, -0.3, 0.0]).repeat(2, 5, 1)
    x[0, 3] = torch.tensor([-0.9, 0.9, 0.5, 0.2, 0.5, 0.4])
    figure = workspace._workspaces(1, 1)[0]
    workspace._judged(figure.axes[0], x, flow.judged["robot"], "two")
    assert figure.axes[0].get_title() == "two\n1 of 2 (50.0%) in violation"
    torch.testing.assert_close(marks(figure.axes[0]), torch.tensor([[0.5, 0.3]]))


def test_the_sources_panel_shows_the_source_and_the_other_what_became_of_it(evaluation: Evaluation) -> None:
    figure = workspace.sources(model(), evaluation)
    for axis, x in zip(figure.axes, (evaluation.source_samples, evaluation.samples["none"]), strict=True):
        shown = x[: workspace.SHOWN].unflatten(2, (2, 2)).transpose(1, 2).flatten(0, 1)
        assert torch.equal(sort(lines(axis)), sort(shown))
        assert f"\n{int((distance(x).amin(dim=1) < 0.3).sum())} of 512 " in axis.get_title()


def test_the_page_judges_each_setting_by_what_it_avoids(data: DemonstrationData, evaluation: Evaluation) -> None:
    flow = model()
    axes = {axis.get_title().split("\n")[0]: axis for axis in workspace.page(flow, data, evaluation, "test").axes}
    for setting in ("none", "robot"):
        count = int((distance(evaluation.samples[setting]).amin(dim=1) < 0.3).sum())
        assert f"\n{count} of 512 " in axes[workspace.titled(setting)].get_title()
    obstacle = axes[workspace.titled("obstacle")]
    guided, unguided = (
        (evaluation.samples[setting].unflatten(2, (2, 2)) - torch.tensor([0.0, 0.5])).norm(dim=3).amin(dim=(1, 2))
        for setting in ("obstacle", "none")
    )
    assert f"\n{int((guided < 0.25).sum())} of 512 " in obstacle.get_title()
    assert f"unguided: {int((unguided < 0.25).sum())} of 512 " in obstacle.get_xlabel()
    circles = [patch for patch in obstacle.patches if isinstance(patch, Circle)]
    assert [(circle.center, circle.radius) for circle in circles] == [((0.0, 0.5), 0.1), ((0.0, 0.5), 0.25)]
    assert bool(((marks(obstacle) - torch.tensor([0.0, 0.5])).norm(dim=1) < 0.25).all())
    assert len(marks(obstacle)) == int((guided[: workspace.SHOWN] < 0.25).sum())


def test_the_page_shows_the_demonstrations_of_its_split_and_says_which(
    data: DemonstrationData, evaluation: Evaluation
) -> None:
    for split, name in config.SPLITS.items():
        figure = workspace.page(model(), data, evaluation, split)
        assert figure.get_suptitle() == f"cgp-s0, preset smoke, {name} split"
        assert figure.axes[0].get_title().startswith(f"{name} demonstrations\n")
        shown = data.held_out[split].x[: workspace.SHOWN].unflatten(2, (2, 2)).transpose(1, 2).flatten(0, 1)
        assert torch.equal(sort(lines(figure.axes[0])), sort(shown))


def test_the_frames_of_the_flow_are_its_states(evaluation: Evaluation) -> None:
    """Ten steps of Euler written out, of which every second is a frame."""
    flow, x_0 = model(), evaluation.source_samples
    axes = workspace.flow(flow, x_0).axes
    assert [axis.get_title().split("\n")[0] for axis in axes] == [f"$t = {t:g}$" for t in (0, 0.2, 0.4, 0.6, 0.8, 1)]
    x = x_0
    with torch.no_grad():
        for k in range(11):
            if k % 2 == 0:
                shown = x[: workspace.SHOWN].unflatten(2, (2, 2)).transpose(1, 2).flatten(0, 1)
                torch.testing.assert_close(sort(lines(axes[k // 2])), sort(shown))
            x = x + flow.v(x, torch.full((512,), k / 10)) / 10


def test_the_clearances_are_the_gaps_between_the_robots(evaluation: Evaluation) -> None:
    for axis, setting in zip(workspace.clearances(model(), evaluation).axes, SETTINGS, strict=True):
        drawn = torch.tensor(np.array([line.get_ydata() for line in axis.lines if line.get_linestyle() == "-"]))
        expected = distance(evaluation.samples[setting][: workspace.SHOWN]) - 0.3
        torch.testing.assert_close(sort(drawn), sort(expected), rtol=0, atol=1e-6)  # float32
        assert np.array_equal(np.asarray(axis.lines[-1].get_ydata()), [0, 0])
        assert "clearance" in axis.get_ylabel() or setting != "none"


def test_what_counts_as_touching_is_drawn_where_samples_are_judged(
    data: DemonstrationData, evaluation: Evaluation
) -> None:
    """With a radius of their own samples are judged, coloured and drawn by that one."""
    flow, shown = model("sample.radius=0.2"), evaluation.samples["none"][: workspace.SHOWN]
    nearest = distance(shown).amin(dim=1)
    assert bool(((nearest > 0.2) & (nearest < 0.3)).any())
    for axis in (
        workspace.clearances(flow, evaluation).axes[0],
        workspace.page(flow, data, evaluation, "test").axes[5],
    ):
        drawn = [line for line in axis.lines if line.get_linestyle() == "-"]
        found = torch.tensor(np.array([line.get_ydata() for line in drawn]))
        torch.testing.assert_close(sort(found), sort(distance(shown) - 0.2), rtol=0, atol=1e-6)  # float32
        colliding = torch.tensor([line.get_color() == workspace.COLLISION for line in drawn])
        assert torch.equal(colliding, found.amin(dim=1) < 0)
        assert np.array_equal(np.asarray(axis.lines[-1].get_ydata()), [0, 0])
    content = json.loads(animation(flow, evaluation, "").split("const content = ")[1].split(";\n")[0])
    # The obstacle is met by the discs that its guidance knows.
    assert [panel["radii"] for panel in content["scenes"][0]["panels"]] == [[0.1, 0.1], [0.1, 0.1], [0.15, 0.15]]


class Hall(Task):
    """Robots that go straight through a hall, at a limited speed, and at inference around two pillars."""

    T = 12
    PILLARS = [(0.0, 0.3, 0.1), (0.2, -0.4, 0.15)]  # noqa: RUF012

    def __init__(self, count: int = 3) -> None:
        self.robots = Discs(count, [0.05 + 0.02 * i for i in range(count)])

    def constraints(self) -> dict[str, Constraint]:
        return {"robot": RobotAvoidance(self.robots), "speed": SpeedLimit(self.robots, 2.2, self.dt)}

    def constraints_at_inference(self) -> dict[str, Constraint]:
        return {"pillars": ObstacleAvoidance(self.robots, [Obstacle(*pillar) for pillar in self.PILLARS])}

    def obstacles(self) -> list[tuple[float, float, float]]:
        return self.PILLARS

    def demonstrations(self, num: int, seed: int) -> Tensor:
        noise = torch.Generator().manual_seed(seed)
        p, q = (0.9 * (2 * torch.rand(num, 1, self.robots.D, generator=noise) - 1) for _ in range(2))
        return torch.lerp(p, q, torch.linspace(0, 1, self.T)[:, None])


class Post(Hall):
    """One robot and a post that is always there."""

    def __init__(self) -> None:
        super().__init__(1)

    def constraints(self) -> dict[str, Constraint]:
        return {"post": ObstacleAvoidance(self.robots, [Obstacle(*self.PILLARS[1])])}

    def constraints_at_inference(self) -> dict[str, Constraint]:
        return {}

    def obstacles(self) -> list[tuple[float, float, float]]:
        return self.PILLARS[1:]


class Sampled(NamedTuple):
    """An untrained model of a task, its demonstrations, and what it makes."""

    model: ConFlow
    data: DemonstrationData
    evaluation: Evaluation


def sampled(task: Task) -> Sampled:
    torch.manual_seed(0)
    settings = config.load(["preset=smoke", "source.kind=cgp"])
    flow, data = ConFlow(settings, task), DemonstrationData(settings, task)
    return Sampled(flow, data, gallery.sample(flow, cycle(data.test.x, 40)))


def circles(axis: Axes) -> list[tuple[float, ...]]:
    shown = [patch for patch in axis.patches if isinstance(patch, Circle)]
    return [(*circle.center, circle.radius) for circle in shown]


def test_several_constraints_mark_a_collision_amid_the_bodies_that_come_so_close() -> None:
    """Neither where the fastest robot is, nor amid all of which some barrier pushes."""
    task = Hall()
    x = torch.tensor([-0.9, 0.9, 0.3, 0.0, -0.3, 0.0]).repeat(3, 5, 1)
    x[0, :, 2:] = torch.tensor([0.5, 0.2, 0.5, 0.3])  # too near all the time, while the first goes somewhere
    x[0, :, 0] = torch.linspace(-0.9, -0.5, 5)
    x[1, :, 4:] = torch.tensor([0.3, 0.0])  # in one place all the time
    x[2, 1:, 0] = 0.9  # far too fast, between the first two waypoints
    trained = Sum(list(task.constraints().values()))
    found = workspace._contacts(x, trained)
    torch.testing.assert_close(found[:2], torch.tensor([[0.5, 0.25], [0.3, 0.0]]))
    assert found[2].abs().tolist() == pytest.approx([0.9, 0.9]), "where the fast one was, or where it is then"


def test_of_a_crowd_one_trajectory_is_drawn_when_there_is_least_room_and_all_that_is_violated() -> None:
    """Of nine robots in rows the first two touch once; in the second trajectory two others do, in the third none."""
    robots = Crowd(9, 0.05)
    x = torch.tensor([[0.4 * i - 0.8, 0.4 * j] for i in range(3) for j in range(3)]).flatten().repeat(3, 5, 1)
    x[0, 3, :4] = torch.tensor([-0.8, 0.2, -0.8, 0.24])
    x[1, 1, 14:] = torch.tensor([0.5, 0.5, 0.5, 0.52])
    figure = workspace._workspaces(1, 2)[0]
    for shown, axis in zip((x, x[2:]), figure.axes, strict=True):
        workspace._judged(axis, shown, CrowdAvoidance(robots), "nine")
    first, clear = figure.axes
    discs = [patch for patch in first.patches if isinstance(patch, Circle)]
    torch.testing.assert_close(torch.tensor([disc.center for disc in discs]), x[0, 3].unflatten(0, (9, 2)))
    assert [disc.radius for disc in discs] == pytest.approx([0.05] * 9)
    touching = [to_hex(disc.get_facecolor()) == workspace.COLLISION.lower() for disc in discs]
    assert touching == [True, True] + [False] * 7
    assert torch.equal(sort(lines(first)), sort(x[0].unflatten(1, (9, 2)).transpose(0, 1)))
    torch.testing.assert_close(marks(first), torch.tensor([[-0.8, 0.22], [0.5, 0.51]]))
    assert len(marks(clear)) == 0
    workspace._legend(figure, robots)
    assert written_outside(figure) == []


def test_what_is_too_fast_is_no_collision() -> None:
    """Titles and legends speak of violations, whatever is violated."""
    flow, data, evaluation = sampled(Hall())
    for figure in (workspace.page(flow, data, evaluation, "test"), workspace.clearances(flow, evaluation)):
        assert any(" in violation" in axis.get_title() for axis in figure.axes)
        assert not [text for text in figure.findobj(Text) if re.search("colli[ds]", text.get_text())]


def test_obstacles_are_drawn_where_they_are_there() -> None:
    """A post of the training is in every panel; pillars that appear at inference in their own alone."""
    always, appearing = sampled(Post()), sampled(Hall())
    post = [pytest.approx((0.2, -0.4, 0.15)), pytest.approx((0.2, -0.4, 0.2))]
    flow, data, evaluation = always
    for figure in (
        workspace.demonstrations(data),
        workspace.sources(flow, evaluation),
        workspace.flow(flow, evaluation.source_samples),
        workspace.methods([("one", flow, evaluation)]),
    ):
        assert all(circles(axis) == post for axis in figure.axes)
    *spaces, curves_ = workspace.page(flow, data, evaluation, "test").axes
    assert [axis.get_title().split("\n")[0] for axis in spaces[2:]] == ["generated, no guidance", "guided around post"]
    assert all(circles(axis) == post for axis in spaces)
    assert circles(curves_) == []
    flow, data, evaluation = appearing
    axes = {axis.get_title().split("\n")[0]: axis for axis in workspace.page(flow, data, evaluation, "test").axes}
    pillars = circles(axes.pop("guided around pillars"))
    assert [radius for *_, radius in pillars] == pytest.approx([0.1, 0.1 + 0.09, 0.15, 0.15 + 0.09])
    assert not any(circles(axis) for axis in axes.values())


def test_the_animation_shows_a_post_of_the_training_in_every_panel() -> None:
    for task, there in ((Post(), [True, True]), (Hall(), [False, False, True])):
        flow, _, evaluation = sampled(task)
        content = json.loads(animation(flow, evaluation, "").split("const content = ")[1].split(";\n")[0])
        assert content["obstacles"] == [list(disc) for disc in task.obstacles()]
        assert content["owner"] == list(range(task.robots.count))
        for scene in content["scenes"]:
            assert [panel["obstaclesThere"] for panel in scene["panels"]] == there
            measured = [panel["obstacleGap"] is not None for panel in scene["panels"]]
            assert measured == [False, False, True][: len(there)]
            for panel in scene["panels"]:
                assert panel["radii"] == pytest.approx(task.robots.radii.tolist())


def test_the_gap_of_a_frame_takes_no_frame_for_a_waypoint() -> None:
    """As fast as between its waypoints a robot is between their frames too."""
    task = Hall(1)
    x = torch.zeros(1, 12, 2)
    x[0, :, 0] = torch.linspace(-0.9, 0.9, 12)
    speed, pillars = SpeedLimit(task.robots, 1.5, task.dt), task.constraints_at_inference()["pillars"]
    assert float(speed.clearance(x)[0, 0]) == pytest.approx(-0.3, abs=1e-5)
    assert gaps(speed, x)[0].numpy() == pytest.approx(np.full(frames(x).shape[1], -0.3), abs=1e-5)
    torch.testing.assert_close(gaps(pillars, x), pillars.clearance(frames(x)))
    both = Sum([speed, pillars])
    torch.testing.assert_close(gaps(both, x), torch.minimum(gaps(speed, x), gaps(pillars, x)))


def test_a_run_of_fewer_settings_leaves_no_empty_panel_behind() -> None:
    runs = [("several", *sampled(Hall())[::2]), ("few", *sampled(Post())[::2])]
    figure = workspace.methods(runs)
    assert len(figure.axes) == 5
    assert all(axis.get_title() for axis in figure.axes)


def written_outside(figure: Figure) -> list[str]:
    """Texts and legends that reach out of the picture."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    found = []
    for legend in [*figure.legends, *(axis.get_legend() for axis in figure.axes if axis.get_legend())]:
        assert legend is not None
        found += [(text.get_text(), text.get_window_extent()) for text in legend.get_texts()]
    for axis in figure.axes:
        found += [
            (text.get_text(), text.get_window_extent()) for text in (axis.title, axis.xaxis.label, axis.yaxis.label)
        ]
    found += [(text.get_text(), text.get_window_extent()) for text in figure.findobj(Text) if text is figure._suptitle]  # type: ignore[attr-defined]
    box = figure.bbox
    return [
        text
        for text, extent in found
        if text and not (box.x0 <= extent.x0 and extent.x1 <= box.x1 and box.y0 <= extent.y0 and extent.y1 <= box.y1)
    ]


@pytest.mark.parametrize("task", [Post(), Hall(2), Hall(3), Hall(5)], ids=["1", "2", "3", "5"])
def test_nothing_is_written_outside_a_picture(task: Task) -> None:
    """However many robots there are, and settings, and constraints."""
    flow, data, evaluation = sampled(task)
    x_0 = evaluation.source_samples
    for figure in (
        workspace.demonstrations(data),
        workspace.sources(flow, evaluation),
        workspace.page(flow, data, evaluation, "test"),
        workspace.methods([("one", flow, evaluation), ("other", flow, evaluation)]),
        workspace.clearances(flow, evaluation),
        curves.guidance({setting: guidance(flow, setting, x_0) for setting in flow.settings}),
        curves.guidance_weight(flow, x_0),
        curves.solver_steps(flow, x_0),
    ):
        assert written_outside(figure) == []
        names = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
        if "robot 1" in names:
            assert names[:-1] == [f"robot {i + 1}" for i in range(task.robots.count)]


def test_the_guidance_of_a_task_of_its_own_has_a_panel_for_each_constraint() -> None:
    flow, _, evaluation = sampled(Hall())
    found = {setting: guidance(flow, setting, evaluation.source_samples) for setting in flow.settings}
    _, drift, *barriers = curves.guidance(found).axes
    assert [axis.get_title() for axis in barriers] == ["barrier: robot", "barrier: speed", "barrier: pillars"]
    for axis, name in zip(barriers, ("robot", "speed", "pillars"), strict=True):
        assert curve(axis, "around all")[1] == found["all"].barriers[name].tolist()
    assert drift.get_ylim()[0] == 0
    weights = curves.guidance_weight(flow, evaluation.source_samples).axes
    assert [axis.get_ylabel() for axis in weights] == ["robot- or speed-collision rate", "pillars-collision rate"]


def test_methods_gives_every_run_a_row(evaluation: Evaluation) -> None:
    figure = workspace.methods([("first", model(), evaluation), ("second", model(), evaluation)])
    assert len(figure.axes) == 6
    assert [axis.get_ylabel().split("\n")[0] for axis in figure.axes[::3]] == ["first", "second"]
    assert [axis.get_title() for axis in figure.axes[:3]] == [axis.get_title() for axis in figure.axes[3:]]


def test_rates_over_the_weight_are_those_of_sampling_with_it(evaluation: Evaluation) -> None:
    """Each point is a model with that weight in its config; the band is Wilson's."""
    x_0 = evaluation.source_samples
    axes = curves.guidance_weight(model("sample.robot_weight=0.5"), x_0).axes
    weights, rates = curve(axes[0], "robot-collision rate")
    assert weights == pytest.approx([0, 0.05, 0.5, 1.5, 5, 15, 50])
    for weight, rate in zip(weights, rates, strict=True):
        x = model(f"sample.robot_weight={weight}").flow(x_0, "robot")
        assert rate * 512 == pytest.approx(int((distance(x).amin(dim=1) < 0.3).sum()))
    assert rates[0] > rates[-1]
    band = np.array(axes[0].collections[0].get_paths()[0].vertices)
    for weight, rate in zip(weights, rates, strict=True):
        at = band[np.isclose(band[:, 0], weight), 1]
        assert (at.min(), at.max()) == pytest.approx(wilson(round(rate * 512), 512))
    assert axes[0].lines[-1].get_xdata() == pytest.approx([0.5, 0.5])
    assert "512" in axes[0].get_title()


def test_a_config_without_guidance_still_gets_its_sweep(evaluation: Evaluation) -> None:
    axis = curves.guidance_weight(model("sample.robot_weight=0"), evaluation.source_samples[:20]).axes[0]
    assert curve(axis, "robot-collision rate")[0] == list(curves.FACTORS)


def test_the_solvers_are_drawn_over_the_evaluations_that_they_spend(evaluation: Evaluation) -> None:
    flow, x_0 = model(), evaluation.source_samples
    rates, smooth = curves.solver_steps(flow, x_0).axes
    for solver, each in (("euler", 1), ("midpoint", 2)):
        evaluations, drawn = curve(rates, solver)
        assert evaluations == list(curves.BUDGETS)
        medians = curve(smooth, solver)[1]
        for i in (0, 3):
            x = integrate(flow.v, x_0, int(evaluations[i]) // each, "euler" if each == 1 else "midpoint")
            assert drawn[i] * 512 == pytest.approx(int((distance(x).amin(dim=1) < 0.3).sum()))
            assert medians[i] == pytest.approx(float(smoothness(TWO, x).quantile(0.5)))
    assert rates.lines[-1].get_xdata() == pytest.approx([10, 10])  # preset smoke: 10 steps of Euler


def test_the_guidance_figure_draws_what_was_measured(evaluation: Evaluation) -> None:
    flow = model()
    found = {setting: guidance(flow, setting, evaluation.source_samples) for setting in SETTINGS}
    ratio, drift, robots, obstacle = curves.guidance(found).axes
    for setting in SETTINGS:
        label = curves._label(setting)
        assert curve(robots, label)[1] == found[setting].barriers["robot"].tolist()
        assert curve(obstacle, label)[1] == found[setting].barriers["object"].tolist()
        if setting != "none":
            assert curve(ratio, label)[1] == found[setting].ratio.tolist()
    heights = [patch.get_height() for patch in drift.patches]  # type: ignore[attr-defined]
    assert heights == [
        value for setting in SETTINGS[1:] for value in (found[setting].start_drift, found[setting].end_drift)
    ]


def test_the_animation_needs_nothing_from_outside_and_holds_every_frame(evaluation: Evaluation) -> None:
    flow = model()
    page = animation(flow, evaluation, "a </script> name")
    assert len(page.encode()) < 1_500_000
    assert not re.search(r"https?:|\bsrc\s*=|\bhref\s*=|@import|url\(|\bimport\b|\bfetch\b", page)
    assert page.count("</script>") == 1
    content = json.loads(page.split("const content = ")[1].split(";\n")[0])
    assert content["name"] == "a </script> name"
    collides = distance(evaluation.samples["none"]).amin(dim=1) < 0.3
    assert [": in violation" in scene["label"] for scene in content["scenes"]] == [True, True, False, False]
    for scene in content["scenes"]:
        i = int(scene["label"].split(":")[0])
        assert bool(collides[i]) == (": in violation" in scene["label"])
        for panel, setting in zip(scene["panels"], SETTINGS, strict=True):
            x = evaluation.samples[setting][i]
            positions, gap = torch.tensor(panel["positions"]), torch.tensor(panel["keptGap"])
            fill = (len(positions) - 1) // 31
            assert len(positions) == len(gap) == 31 * fill + 1 > 150
            torch.testing.assert_close(positions[::fill].flatten(1), x, rtol=0, atol=6e-5)  # four digits
            torch.testing.assert_close(gap, distance(positions.flatten(1)) - 0.3, rtol=0, atol=3e-4)
            if ": in violation" in scene["label"] and setting == "none":
                assert float(gap.min()) < 0


def test_frames_go_straight_from_waypoint_to_waypoint() -> None:
    x = torch.tensor([[[0.0, 0], [1, 2], [1, 0]]])
    filled = frames(x)[0]
    assert torch.equal(filled[[0, 100, 200]], x[0])
    torch.testing.assert_close(filled[[25, 150]], torch.tensor([[0.25, 0.5], [1.0, 1.0]]))


def test_colliding_trajectories_are_missing_where_there_are_none(evaluation: Evaluation) -> None:
    flow = model()
    feasible = ~flow.judged["robot"].violation(evaluation.samples["none"])
    apart = Evaluation(
        evaluation.source_samples[feasible], {setting: x[feasible] for setting, x in evaluation.samples.items()}
    )
    scenes = json.loads(animation(flow, apart, "").split("const content = ")[1].split(";\n")[0])["scenes"]
    assert [": in violation" in scene["label"] for scene in scenes] == [False, False]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of its own: these runs have no metrics, which other tests of the shared one would miss."""
    return tmp_path_factory.mktemp("place")


@pytest.fixture
def finished(place: Path, monkeypatch: pytest.MonkeyPatch, data: DemonstrationData, tmp_path: Path) -> Run:
    """A finished run with an untrained model, and with a page that training drew."""
    monkeypatch.chdir(place)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    flow = model_of(config.load(["preset=smoke", "seed=77"]), 32, 4)
    checkpoint = {"state_dict": flow.state_dict()}
    flow.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, tmp_path / "model.ckpt")
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "page.png").write_bytes(b"of training")
    with recording.start(experiment(flow.config, data)) as logger:
        logger.log_files(str(tmp_path))
    return store.find_run(str(logger.run_id))


def test_all_pictures_are_written_and_logged_and_nothing_else_is_touched(
    finished: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workspace, "DPI", 20)
    folder = Path("runs/figures/smoke_cgp-s77")
    folder.mkdir(parents=True)
    (folder / "mine.txt").write_text("kept")
    (folder / "flow.png").write_text("of an earlier call")
    gallery.draw(["cgp-s77"], "val", Console(quiet=True))
    written = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert written.pop("mine.txt") == b"kept"
    pictures = {
        "demonstrations",
        "sources",
        "page",
        "flow",
        "clearances",
        "guidance",
        "solver_steps",
        "guidance_weight",
    }
    pictures.add("taken_back")
    assert written.keys() == {f"{name}.png" for name in pictures} | {"animation.html"}
    assert all(written[f"{name}.png"].startswith(b"\x89PNG") for name in pictures)
    logged = {file.name: file.read_bytes() for file in store.artifact(finished, "figures").iterdir()}
    assert logged.pop("page.png") == b"of training"
    of_training = {"page.png", "demonstrations.png", "sources.png"}
    assert logged == {name: written[name] for name in written.keys() - of_training}


def test_the_pictures_of_the_test_split_take_no_place_of_the_others(
    finished: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their samples are of that split's starts and goals, and their folders and artifacts are apart."""
    asked: list[Tensor] = []
    sample = gallery.sample
    monkeypatch.setattr(workspace, "DPI", 20)

    def watched(flow: ConFlow, x_1: Tensor) -> Evaluation:
        asked.append(x_1)
        return sample(flow, x_1)

    monkeypatch.setattr(gallery, "sample", watched)
    data = demonstrations(finished, model_of(config.load(["preset=smoke", "seed=77"])))
    mine = Path("runs/figures/smoke_cgp-s77/flow.png")
    mine.parent.mkdir(parents=True, exist_ok=True)
    mine.write_text("of the validation split")
    gallery.draw([finished.info.run_id, finished.info.run_id], "test", Console(quiet=True))
    assert all(torch.equal(x_1, cycle(data.test.x, 512)) for x_1 in asked)
    assert mine.read_text() == "of the validation split"
    drawn = {file.name for file in (mine.parent / "test").iterdir()}
    assert {file.name for file in store.artifact(finished, "figures/test").iterdir()} == drawn
    assert {"page.png", "animation.html"} <= drawn
    assert Path("runs/figures/test/methods.png").exists()
    assert "test split" in (mine.parent / "test" / "animation.html").read_text()


def test_several_runs_are_compared_and_a_name_cannot_lead_elsewhere(
    finished: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[Path] = []
    monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: saved.append(path))
    monkeypatch.setattr(gallery, "_log", lambda *_: None)
    store.client().update_run(finished.info.run_id, name="../../elsewhere")
    gallery.draw([finished.info.run_id, "latest"], "val", Console(quiet=True))
    assert {path.parent for path in saved} == {Path("runs/figures/smoke_.._.._elsewhere"), Path("runs/figures")}
    assert [path.name for path in saved if path.parent.name == "figures"] == ["methods.png", "taken_back.png"]


def test_runs_of_one_name_are_told_apart_by_preset_and_by_what_was_changed(finished: Run) -> None:
    titles = []
    for key, value in {"": "", "preset": "quick", "ablation": "removed"}.items():
        if key:
            store.client().set_tag(finished.info.run_id, key, value)
        titles.append(gallery._title(store.client().get_run(finished.info.run_id)))
    assert titles[0] == "smoke/cgp-s77"
    assert titles[1].startswith("quick/cgp-s77 data.num=500 ")
    assert titles[2] == "quick/cgp-s77"  # whose ablation's file is gone, so what was changed is not known


def test_a_second_call_draws_the_same_samples(data: DemonstrationData, evaluation: Evaluation) -> None:
    again = gallery.sample(model("sample.robot_weight=2"), cycle(data.test.x, 512))
    assert torch.equal(again.source_samples, evaluation.source_samples)
    assert all(torch.equal(again.samples[setting], evaluation.samples[setting]) for setting in SETTINGS)
    other = gallery.sample(model("sample.robot_weight=2", "seed=1"), cycle(data.test.x, 512))
    assert not torch.equal(other.source_samples, evaluation.source_samples)


def test_a_mistyped_command_ends_in_one_line(conflow: Command) -> None:
    result = conflow("figures", "runs=latest")
    assert (result.returncode, result.stderr.count("\n")) == (2, 1)
    assert "expected run" in result.stderr


def test_every_curve_says_what_it_shows_in_which_unit(evaluation: Evaluation) -> None:
    flow, x_0 = model(), evaluation.source_samples[:20]
    measured = {setting: guidance(flow, setting, x_0) for setting in SETTINGS}
    for figure in (curves.solver_steps(flow, x_0), curves.guidance_weight(flow, x_0), curves.guidance(measured)):
        for axis in figure.axes:
            assert axis.get_title()
            assert axis.get_xlabel() or [label.get_text() for label in axis.get_xticklabels()] == ["start", "goal"]
            assert re.search("rate|workspace units|/", axis.get_ylabel())
