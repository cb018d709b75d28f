"""Plans for many robots: by the planner for any number of them, and scene by scene in `make planbench`."""

import importlib.util
import json
import re
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.patches import FancyBboxPatch
from rich.console import Console

from conflow import planbench
from conflow.errors import ConfigError
from conflow.figures import workspace
from conflow.figures.planbench import animation, success
from conflow.planner import PlanError, Planner
from conflow.results import peers
from conflow.results import planbench as results
from conflow.results.planbench import Record, Row, Settings
from conflow.results.printing import Format
from conflow.scene.settings import Box
from conflow.scene.tasks import CROWDS
from conflow.scene.tasks.crowd import CrowdTask
from conflow.tracking import store
from conflow.training import config
from conflow.training.build import build_task
from conflow.training.datamodule import DemonstrationData
from conflow.training.model import ConFlow
from conflow.training.progress import ProgressDisplay

SETTINGS = config.load(["task=weave", "ablation=plus", "preset=smoke", "task.robots=[6, 8]"])


@pytest.fixture(scope="module")
def model() -> ConFlow:
    """Not trained, so it flows as its source does: to curves that know nothing of each other."""
    torch.manual_seed(0)
    return ConFlow(SETTINGS, build_task(SETTINGS)).eval()


@pytest.fixture(scope="module")
def weave() -> CrowdTask:
    return CROWDS["weave"](8)


@pytest.mark.parametrize("count", [5, 8, 12])
def test_a_planner_takes_any_number_of_robots(model: ConFlow, count: int) -> None:
    """With the same weights, also more than training saw."""
    start, goal = CROWDS["weave"](count).scene(count, 0, 0)
    state = torch.get_rng_state()
    plans = Planner(model).plan(start, goal, num=6, descent=40)
    assert torch.equal(torch.get_rng_state(), state)
    assert plans.x.shape == (6, 64, 2 * count)
    assert torch.equal(plans.x[:, [0, -1]], torch.stack([start, goal]).expand(6, -1, -1))
    assert bool(plans.feasible[0])
    sized = model.of_numbers(2 * count)
    weights = zip(sized.v.parameters(), model.v.parameters(), strict=True)
    assert all(ours.data_ptr() == theirs.data_ptr() for ours, theirs in weights)


def test_descent_makes_plans_feasible_and_is_the_runs_own_by_default(model: ConFlow) -> None:
    start, goal = CROWDS["weave"](14).scene(14, 0, 1)
    raw, own, longer = (Planner(model).plan(start, goal, 16, guidance="none", descent=k) for k in (0, None, 60))
    assert SETTINGS.sample.descent > 0
    assert int(raw.feasible.sum()) < int(own.feasible.sum()) <= int(longer.feasible.sum())
    with pytest.raises(PlanError, match=r"^descent=-1: expected a whole number of at least 0$"):
        Planner(model).plan(start, goal, descent=-1)


def test_descent_keeps_obstacles_and_via_points_too(model: ConFlow) -> None:
    start, goal = CROWDS["weave"](8).scene(8, 0, 1)
    obstacle, via = (0.1, 0.1, 0.12), CROWDS["circle"](8).scene(8, 0, 0)[0]
    plans = Planner(model).plan(start, goal, 16, [obstacle], [(0.3, via)], descent=80)
    assert torch.equal(plans.x[:, round(0.3 * 63)], via.expand(16, -1))
    assert bool(plans.feasible[0])
    distance = (plans.x[0].unflatten(1, (-1, 2)) - torch.tensor(obstacle[:2])).norm(dim=2)
    assert float(distance.min()) >= 0.12 + 0.05 - 1e-6


def test_the_best_of_candidates_is_there_as_soon_as_one_is_feasible(model: ConFlow) -> None:
    start, goal = CROWDS["weave"](8).scene(8, 0, 2)
    seen: list[float] = []
    best = Planner(model).best_of(start, goal, num=8, progress=lambda seconds, clearance: seen.append(clearance))
    assert best.x.shape == (1, 64, 16)
    assert bool(best.feasible[0])
    assert seen == sorted(seen)
    assert all(clearance < 0 for clearance in seen[:-1])
    assert seen[-1] == float(best.clearance[0]) >= 0


def test_without_a_feasible_one_the_nearest_to_it_comes_when_time_is_up(model: ConFlow) -> None:
    start, goal = CROWDS["weave"](28).scene(28, 0, 2)
    best = Planner(model).best_of(start, goal, num=4, seconds=0)
    assert best.x.shape == (1, 64, 56)
    first = Planner(model).plan(start, goal, num=4, descent=0)
    assert not first.feasible.any()
    assert float(best.clearance[0]) == float(first.clearance.max()) > float(first.clearance[0])
    assert not best.feasible[0]


def test_the_best_of_candidates_is_of_one_pair_and_of_all_obstacles(model: ConFlow) -> None:
    """Also of those that can be gone through only once."""
    start, goal = CROWDS["weave"](8).scene(8, 0, 2)
    obstacles = [(0.1, 0.1, 0.12), (-0.3, 0.2, 0.05)]
    once = Planner(model).best_of(start, goal, num=4, obstacles=iter(obstacles))  # type: ignore[arg-type]
    assert torch.equal(once.x, Planner(model).best_of(start, goal, num=4, obstacles=obstacles).x)
    for said, refused in {
        "start=tensor.*found shape": {"start": start[None], "goal": goal[None]},
        "seed=x: expected a whole number": {"start": start, "goal": goal, "seed": "x"},
        "seconds=x: expected a finite number": {"start": start, "goal": goal, "seconds": "x"},
    }.items():
        with pytest.raises(PlanError, match=f"^{said}"):
            Planner(model).best_of(**refused)


def test_the_audit_sees_what_happens_between_waypoints_and_at_the_ends(weave: CrowdTask) -> None:
    scene = weave.scene(8, 0, 0)
    line = torch.lerp(scene[None, :1], scene[None, 1:], torch.linspace(0, 1, 64)[None, :, None])
    parked = scene[:1].expand(1, 64, -1).clone()
    still = torch.stack([scene[0], scene[0]])[None]
    assert planbench.feasible(weave, parked, still).tolist() == [True]
    assert planbench.feasible(weave, line, scene[None]).tolist() == [False]
    jumping = parked.clone()
    jumping[:, 30:, :2] = -parked[:, 30:, :2]  # through the middle in one step, to where nobody is
    jumping[:, :, 2:4], jumping[:, :, 4:] = 0.0, torch.linspace(0.6, 0.9, 12)
    at_waypoints = weave.constraints()["robot"].clearances(jumping)[:, :, 0]
    assert (at_waypoints > 0).all()
    assert planbench.kept(weave, jumping).tolist() == [False]
    moved = parked.clone()
    moved[:, -1, 0] += 2e-5
    assert planbench.feasible(weave, moved, still).tolist() == [False]
    outside = parked.clone()
    outside[:, 20:40, 0] = 1.01
    assert planbench.feasible(weave, outside, still).tolist() == [False]


@pytest.fixture(scope="module")
def record(model: ConFlow) -> Record:
    settings = Settings(num=4, limit=20.0, looked=2)
    with ProgressDisplay(Console(quiet=True)) as display:
        return planbench.run(SETTINGS, {"ours": model}, 8, 3, seed=1, settings=settings, display=display)


def test_every_method_is_asked_the_same_scenes(record: Record) -> None:
    names = ["descent, no model", "ours", *(["ORCA (pyrvo)"] if importlib.util.find_spec("pyrvo") else [])]
    assert [row.method for row in record.rows] == names
    for row in record.rows:
        assert row.scenes == len(row.seconds) == 3
        assert row.solved == 3
        assert row.path_length is not None
        assert 1.7 < row.path_length < 3  # the straight line has 1.74
    none, ours, *_ = record.rows
    assert (ours.raw, ours.guided, none.raw) == (8, 8, 8)
    assert none.raw_feasible == none.guided_feasible
    assert none.conflicts is not None
    assert none.conflicts > 0
    assert ours.guided_feasible >= ours.raw_feasible


def printed(records: list[Record], form: Format) -> str:
    console = Console(width=300)
    with console.capture() as captured:
        results.render(records, form, console)
    return captured.get()


def test_a_record_is_read_as_it_was_written_and_none_is_overwritten(record: Record, tmp_path: Path) -> None:
    paths = [results.write(record, tmp_path) for _ in range(2)]
    paths[0].unlink()  # of which the picture is kept
    paths[0].with_suffix(".gif").write_text("precious")
    assert results.write(record, tmp_path).stem == f"{paths[0].stem}-3"
    paths[0].with_suffix(".gif").unlink()
    assert results.write(record, tmp_path) == paths[0]
    assert [path.name for path in paths] == ["weave-8.json", "weave-8-2.json"]
    assert [results.read(path) for path in paths] == [record, record]
    paths[0].write_text("{}")
    with pytest.raises(ConfigError, match=r"weave-8\.json: expected a record of make planbench, found"):
        results.read(paths[0])


def test_a_record_is_printed_in_every_form(record: Record) -> None:
    row = next(line for line in printed([record], "table").splitlines() if "descent, no model" in line)
    assert "3/3 [0.439, 1.000]" in row
    assert f"{mean(record.rows[0].seconds):.3f}" in row
    assert "| descent, no model | 3/3 [0.439, 1.000] |" in printed([record], "markdown")
    assert json.loads(printed([record], "json"))[0]["rows"][0]["passed"] == [True] * 3
    lines = printed([record], "csv").splitlines()
    assert lines[0] == "task,robots,scene,method,solved,seconds"
    assert len(lines) == 1 + 3 * len(record.rows)


def test_what_is_published_stands_apart_with_its_hardware(record: Record) -> None:
    larger = Record("weave", 28, 1, record.settings, "here", record.rows)
    text = printed([record, larger], "markdown")
    assert f"| published: {peers.AKULE}, one large GPU | 512/512 | 29.9 |" in text
    overview = text.splitlines()
    assert overview[2] == "|  | weave, 8 | weave, 28 |"
    assert overview[4].startswith("| descent, no model | 3/3 [0.439, 1.000]<br>")
    assert overview[4 + len(record.rows)].startswith(
        "| published, on one large GPU |  | Akule 512/512, 29.9 s<br>MMD 512"
    )


def test_several_seeds_are_one_row_of_the_overview_and_other_settings_are_rows_of_their_own() -> None:
    """Of two seeds one solved four scenes in 1 or 2 s, the other two of the same in 3 or 4 s: 3 of 4 on average."""
    some = Row("plus-s0, 5 steps", [True] * 4, [1.0, 2.0] * 2)
    other = Row("plus-s1, 5 steps", [True, False] * 2, [3.0, 4.0] * 2)
    guided = Row("long/plus-s0, 5 steps, guided", [False], [5.0])
    weave, room = (
        Record(task, 8, 1, {"num": 4, "limit": 5}, "here", rows)
        for task, rows in (("weave", [some, other]), ("room", [some, guided]))
    )
    rows = printed([weave, room], "markdown").split("\n\n")[1].splitlines()[2:-1]
    assert rows == [
        "| plus, 5 steps | 6/8 [0.301, 0.954]<br>2.500 s | 4/4 [0.510, 1.000]<br>1.500 s |",
        "| long/plus, 5 steps, guided |  | 0/1 [0.000, 0.793]<br>5.000 s |",
    ]


def test_a_model_meets_maps_and_radii_that_it_was_not_trained_on(model: ConFlow) -> None:
    settings = Settings(num=2, limit=20.0, looked=1)
    for task, robots in (("basic", 6), ("scaled_weave", 32)):
        named = config.load([f"task={task}", "ablation=plus"])
        made = planbench.with_scenes(named, robots)
        scene, ends = made.in_scene(robots, 0, 0), made.scene(robots, 0, 0)
        ours = planbench.of_model("ours", model, named, settings)
        x, _ = ours.solve(scene, ends, 0)
        assert x is not None
        assert bool(planbench.feasible(scene, x[None], ends[None]).all())
        assert ours.propose is not None
        there = ours.propose(scene, ends, 2, 0)
        assert torch.equal(there, ours.propose(scene, ends, 2, 0))
        assert torch.equal(there[:, [0, -1]], ends.expand(2, -1, -1))
        # What it meets there moves what the same network makes of the same noise.
        elsewhere = CROWDS["weave"](robots)
        assert not torch.equal(there, ours.propose(elsewhere, ends, 2, 0))


def test_arms_are_asked_scenes_too() -> None:
    """A scene is a function of its number; what no model made is a new demonstration between its start and goal."""
    settings = config.load(["task=planar_arms", "ablation=plus", "preset=smoke"])
    task = planbench.with_scenes(settings, 2)
    assert torch.equal(task.scene(2, 1, 3), task.scene(2, 1, 3))
    assert not torch.equal(task.scene(2, 1, 3), task.scene(2, 1, 4))
    ends = task.scene(2, 1, 3)
    draws = task.between(ends.expand(32, -1, -1), torch.Generator().manual_seed(0))
    assert (draws[:, [0, -1]] - ends).abs().max() < 1e-6
    assert bool(planbench.feasible(task, draws, ends.expand(32, -1, -1)).any())
    model = ConFlow(settings, build_task(settings)).eval()
    with ProgressDisplay(Console(quiet=True)) as display:
        made = planbench.run(settings, {"ours": model}, 2, 2, 1, Settings(num=4, limit=20.0, looked=1), display)
    assert [(row.method, row.solved) for row in made.rows] == [("descent, no model", 2), ("ours", 2)]
    none = made.rows[0]
    assert none.path_length is not None
    assert (none.adherence, none.conflicts) == (None, None)
    assert "ORCA" not in printed([made], "table")
    with pytest.raises(ConfigError, match=r"^task planar_arms: robots=3: expected 2$"):
        planbench.run(settings, {}, 3, 1, 1, Settings(), display)


def test_the_benchmark_is_of_crowds_that_find_room(model: ConFlow) -> None:
    settings = Settings()
    with ProgressDisplay(Console(quiet=True)) as display:
        with pytest.raises(ConfigError, match=r"^task=swap: expected a task of many robots or of arms, such as"):
            planbench.run(config.load(), {}, 2, 1, 0, settings, display)
        crowded = config.load(["task=random", "preset=smoke"])
        with pytest.raises(ConfigError, match=r"^task random: robots=300: expected fewer"):
            planbench.run(crowded, {}, 300, 1, 0, settings, display)


def asked(**chosen: str) -> dict[str, str]:
    """All options of the command."""
    options = {"task": "weave", "n": "8", "scenes": "1", "run": "none", "seed": "0", "num": "2", "limit": "1"}
    return options | {"guided": "0", "format": "csv", "reference": "0", "out": "none"} | chosen


@pytest.mark.parametrize(
    ("option", "said"), [("n=1", "n=1: expected"), ("scenes=0", "scenes=0: expected"), ("limit=x", "limit=x: expected")]
)
def test_an_option_that_cannot_be_used_is_named(option: str, said: str) -> None:
    key, value = option.split("=")
    options = asked(run="x") | {key: value}
    with pytest.raises(ConfigError) as refused:
        planbench.planbench(options, [], Console(quiet=True))
    assert str(refused.value).startswith(said)


def test_without_a_model_an_option_that_is_none_is_named_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"^limt: no such option, expected task, .*; did you mean limit\?$"):
        planbench.planbench(asked(), ["limt=20"], Console(quiet=True))


def test_a_place_for_records_that_is_none_is_refused_before_anything_is_solved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("precious")
    with pytest.raises(ConfigError, match=r"^out=file: File exists, expected a folder$"):
        planbench.planbench(asked(scenes="100000", out="file"), [], Console(quiet=True))


def test_models_of_one_name_are_told_apart_by_their_preset_and_the_same_twice_is_refused(
    model: ConFlow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two presets, one of which makes smaller networks."""
    other = config.load(["task=weave", "ablation=plus", "preset=quick", f"sample.steps={SETTINGS.sample.steps}"])
    runs = {"smoke/weave-plus-s0": model, "quick/weave-plus-s0": ConFlow(other, build_task(other)).eval()}
    monkeypatch.setattr(store, "find_run", lambda name: name)
    monkeypatch.setattr(store, "artifact", lambda run, _: run)
    monkeypatch.setattr(planbench, "load_model", lambda path, _: runs[path])
    console = Console(width=300)
    with console.capture() as captured:
        planbench.planbench(asked(run=",".join(runs), out=str(tmp_path)), [], console)
    steps = f"{SETTINGS.sample.steps} steps"
    for name in (f"smoke/plus-s0, {steps}", f"quick/plus-s0, {steps}"):
        assert captured.get().count(f'"{name}"') == 1
    twice = ",".join([*runs, "quick/weave-plus-s0"])
    with pytest.raises(ConfigError, match=r"^run=quick/weave-plus-s0: found quick/plus-s0, .* twice, expected once$"):
        planbench.planbench(asked(run=twice), [], Console(quiet=True))


def test_one_plan_is_drawn_in_motion(record: Record, tmp_path: Path) -> None:
    animation(
        torch.tensor(record.plan), 0.05, [Box(0, 0, 0.8, 0.1, 0.015), Box(0.5, 0.5, 0.2, 0.2)], tmp_path / "plan.gif"
    )
    assert (tmp_path / "plan.gif").read_bytes().startswith(b"GIF89a")
    assert (tmp_path / "plan.gif").stat().st_size < 500_000
    assert np.array(record.plan).shape == (64, 16)


def test_the_share_of_solved_scenes_rises_with_the_time_that_each_may_take() -> None:
    """Also of who solves none there is a line to be seen."""
    figure = success("weave", 8, {"some": ([3.0, 1.0, 2.0], [True, True, False]), "none": ([4.0] * 3, [False] * 3)})
    some, none = (np.asarray(line.get_xydata(), dtype=float) for line in figure.axes[0].lines)
    np.testing.assert_allclose(some, [[1.0, 0.0], [1.0, 1 / 3], [3.0, 2 / 3], [4.0, 2 / 3]])
    np.testing.assert_allclose(none, [[1.0, 0.0], [4.0, 0.0]])
    assert figure.axes[0].get_ylim()[0] < 0


def test_a_map_is_drawn_where_trajectories_are(tmp_path: Path) -> None:
    settings = config.load(["task=shelf", "preset=smoke", "task.robots=3", "data.num=20"])
    figure = workspace.demonstrations(DemonstrationData(settings))
    boxes = CROWDS["shelf"](3).boxes()
    for axis in figure.axes:
        drawn = [patch for patch in axis.patches if isinstance(patch, FancyBboxPatch)]
        assert len(drawn) == len(boxes) == 12
        for patch, box in zip(drawn, boxes, strict=True):
            around = patch.get_path().get_extents(patch.get_transform() - axis.transData)
            np.testing.assert_allclose(
                [around.x0, around.y0, around.x1, around.y1],
                [box.x - 0.1768, box.y - 0.1768, box.x + 0.1768, box.y + 0.1768],
                atol=1e-3,
            )


def test_the_readme_s_lines_plan_for_28_robots(model: ConFlow, monkeypatch: pytest.MonkeyPatch) -> None:
    """With whatever model: this one was not trained."""
    text = (Path(__file__).parents[1] / "README.md").read_text()
    (lines,) = re.findall(r"```python\n(from math .*?)planner = Planner.load\(.pandas", text, re.DOTALL)
    assert len(lines.splitlines()) <= 10
    monkeypatch.setattr(Planner, "load", classmethod(lambda cls, run: cls(model)))
    known: dict[str, Any] = {}
    exec(lines, known)
    assert known["plans"].x.shape == (1, 64, 56)
    assert bool(known["plans"].feasible[0])
