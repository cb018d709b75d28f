"""What a task brings, what follows from it by itself, and the file that one is read from."""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import conflow
from conflow.errors import ConfigError
from conflow.scene.constraint import Constraint, ObstacleAvoidance, RobotAvoidance, Workspace
from conflow.scene.robots import Discs, Robots
from conflow.scene.settings import Obstacle
from conflow.scene.task import Task
from conflow.scene.tasks import TASKS
from conflow.scene.tasks.swap import Swap
from conflow.training import config
from conflow.training.build import build_task, file_of, task_of_file
from conflow.training.model_file import load_model
from conflow.training.module import Training


class Moving(Task):
    """Two constraints in training, one at inference."""

    robots: Robots = Discs(2)
    T, seconds = 11, 5.0

    def constraints(self) -> Mapping[str, Constraint]:
        return {"robot": RobotAvoidance(self.robots), "walls": Workspace(self.robots)}

    def constraints_at_inference(self) -> Mapping[str, Constraint]:
        return {"object": ObstacleAvoidance(self.robots, [Obstacle(0.0, 0.5, 0.1)])}

    def demonstrations(self, num: int, seed: int) -> Tensor:
        return torch.zeros(num, self.T, 4)


class TwoArms(Moving):
    """One constraint, and none at inference; all else as it is by default."""

    T, seconds = Task.T, Task.seconds

    def constraints(self) -> Mapping[str, Constraint]:
        return {"robot": RobotAvoidance(self.robots)}

    def constraints_at_inference(self) -> Mapping[str, Constraint]:
        return {}


def test_a_task_says_by_itself_what_follows_from_the_rest() -> None:
    """All that training keeps is guided around together, what appears at inference by itself."""
    task = Moving()
    assert task.dt == 0.5
    assert task.settings() == {"all": ("robot", "walls"), "object": ("object",)}
    assert list(task.judged()) == ["robot", "walls", "object"]


def test_of_a_single_constraint_the_setting_has_its_name() -> None:
    task = TwoArms()
    assert (task.T, task.seconds, task.scale, task.offset) == (32, 1.0, 1.0, 0.0)
    assert task.dt == 1 / 31
    assert task.settings() == {"robot": ("robot",)}
    assert list(task.judged()) == ["robot"]
    assert task.constraints_at_inference() == {}
    assert task.obstacles() == ()


@pytest.mark.parametrize(
    ("words", "name"),
    [("Swap", "swap"), ("TwoArms", "two_arms"), ("ThreeDArms2Go", "three_darms2_go"), ("UAV", "uav"), ("mine", "mine")],
)
def test_a_task_is_called_as_its_class(words: str, name: str) -> None:
    assert type(words, (Moving,), {})().name == name


def test_the_names_of_tasks_are_those_of_the_files_and_of_the_classes() -> None:
    assert sorted(TASKS) == config.names("task")
    for name, kind in TASKS.items():
        task = build_task(config.load([f"task={name}"]))
        assert type(task) is kind
        assert task.name == name


def test_the_settings_of_swaps_arrive_in_the_task() -> None:
    arguments = ("data.horizon=20", "constraint.radius=0.4", "sample.radius=0.25", "sample.obstacle.x=0.25")
    settings = config.load([*arguments, "sample.object_radius=0.125", "data.amplitudes=[0.5]", "data.jitter=0.01"])
    task = build_task(settings)
    assert isinstance(task, Swap)
    assert (task.T, task.robots.D) == (20, 4)
    assert (task.robots.radii.tolist(), task.judges.radii.tolist()) == ([0.2, 0.2], [0.125, 0.125])
    assert task.obstacle == settings.sample.obstacle == Obstacle(0.25, 0.5, 0.1)
    assert task.obstacles() == [(0.25, 0.5, 0.1)]
    assert (task.amplitudes, task.jitter) == ([0.5], 0.01)
    assert task.demonstrations(3, 0).shape == (3, 20, 4)
    # Trained and judged at distances of their own: 0.3 apart collides for training, and not for judgement.
    x = torch.tensor([[[0.0, 0.0, 0.3, 0.0]]])
    assert task.constraints()["robot"].violation(x).tolist() == [True]
    assert task.judged()["robot"].violation(x).tolist() == [False]
    meets = torch.tensor([[[0.25, 0.3, 0.9, 0.9]]])
    assert task.constraints_at_inference()["object"].violation(meets).tolist() == [True]
    assert task.judged()["object"].violation(meets).tolist() == [False]
    # Demonstrations of a file have waypoints and robots of their own.
    other = build_task(settings, 50, 6)
    assert (other.T, other.robots.count) == (50, 3)


COMPLETE = """
import torch, conflow
class Mine(conflow.Task):
    robots = conflow.Discs(1)
    def constraints(self): return {"walls": conflow.Workspace(self.robots)}
    def demonstrations(self, num, seed): return torch.zeros(num, 32, 2)
"""


KEPT = (
    COMPLETE.replace("conflow.Workspace", "Walls")
    + """
class Walls(conflow.Constraint):
    def clearance(self, x): return x"""
)
"""With a constraint of one's own, up to what its clearance is."""


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
        *(
            (COMPLETE + changed, f"{name}: expected another name than none and refined, which are settings of every")
            for name in ("none", "refined")
            for changed in (
                f'    def settings(self): return {{"{name}": ("walls",)}}\n',
                f'    def constraints(self): return {{"{name}": conflow.Workspace(self.robots)}}\n',
            )
        ),
        *(
            (COMPLETE.replace('"walls"', name), "expected a name of letters, digits, _ and -, other than torch's own")
            for name in ('"w/alls"', '"wall.left"', '"wall (left)"', '""', '"type"', '"training"', "3", "None")
        ),
        (
            COMPLETE + "    def constraints_at_inference(self): return self.constraints()\n",
            "expected other names at inference, found walls",
        ),
        *(
            (f"{COMPLETE}    offset = {offset}\n", f"offset={offset}: expected a number, or 2, one for each of a")
            for offset in ("(1.0, 2.0, 3.0)", "[1.0]", "[[1.0, 2.0]]", "[]", "None", "[1.0, None]")
        ),
        (COMPLETE + "    scale = (1.0, 2.0, 3.0)\n", "scale=(1.0, 2.0, 3.0): expected a number, or 2, one for each"),
        (
            f"{KEPT}.norm(dim=(1, 2))\n",
            "walls: clearance of x (2, 32, 2): found torch.float32 of shape (2,), expected floating-point",
        ),
        (
            f"{KEPT}[..., 0] > 0\n",
            "walls: clearance of x (2, 32, 2): found torch.bool of shape (2, 32), expected floating-point",
        ),
        (
            f"{KEPT}[..., 0] - torch.zeros(32)\n",
            "walls: swept_clearance of x (2, 32, 2): found RuntimeError: The size of tensor a (249) must match",
        ),
        (
            "from conflow.scene import constraint\n"
            + COMPLETE.replace("conflow.Workspace", "constraint.RobotAvoidance"),
            "ValueError: one robot: expected two or more",
        ),
        ("import conflow\nTask = conflow.Task\n", "expected one class that is a conflow.Task, found none"),
        ("from conflow.scene.tasks.swap import Swap\n", "expected one class that is a conflow.Task, found none"),
        (COMPLETE + "    def __init__(self, limit): pass\n", "TypeError: "),
        (COMPLETE + "    def __init__(self): 1 / 0\n", "ZeroDivisionError: division by zero"),
        ("import nothing_of_this_name\n", "ModuleNotFoundError: "),
        ("import sys\nsys.exit(0)\n", "SystemExit: 0"),
        (COMPLETE.replace("(1)", "(0)"), "ValueError: 0 discs of radius 0.15: expected one or more"),
        (COMPLETE.replace("def demonstrations", "def demonstration"), "expected Mine to define demonstrations"),
        ("\0", "source code string cannot contain null bytes"),
    ],
    ids=[
        *("none", "two", "fails", "syntax", "abstract", "no robots", "no constraint", "unknown constraint"),
        *("setting none", "constraint none", "setting refined", "constraint refined"),
        *("slash", "dot", "bracket", "empty", "torch's", "torch's own", "number", "None", "twice"),
        *("long offset", "short offset", "nested offset", "empty offset", "no offset", "half an offset"),
        "long scale",
        *("clearance of a trajectory", "clearance of yes and no", "clearance of so many waypoints"),
        "broken constraints",
        *("imported base", "imported task", "argument", "fails when made", "import"),
        *("exit", "no robot", "mistyped method", "no text"),
    ],
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


@pytest.mark.parametrize("name", ["missing.py", ".", "x" * 200 + ".py"])
def test_a_file_that_is_none_is_refused_in_one_line(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r": no such file, expected a Python file that defines a Task$") as refused:
        task_of_file(Path(name))
    assert len(str(refused.value)) < 150


def test_a_file_that_is_called_as_a_named_task_is_refused(tmp_path: Path) -> None:
    """Also where no settings are asked for it, as in drawing a run."""
    (tmp_path / "swap.py").write_text(COMPLETE)
    with pytest.raises(ConfigError, match=r"expected another name than that of the task swap, .*rename the file$"):
        task_of_file(tmp_path / "swap.py")


@pytest.mark.parametrize("call", [conflow.train, conflow.compare])
def test_an_object_of_a_named_task_is_refused_with_what_to_type(call: Callable[..., Any]) -> None:
    """Before anything is written: a run knows its task by name and settings."""
    with pytest.raises(ConfigError) as refused:
        call(task=TASKS["weave"](10))
    assert (
        str(refused.value) == 'task=Weave(...): expected its name, task="weave", and task__robots=..., task__radius=...'
    )
    with pytest.raises(ConfigError, match=r'^task=Swap\(\.\.\.\): expected its name, task="swap"$'):
        call(task=build_task(config.load()))


class Limited(TwoArms):
    """A task that is made with something."""

    def __init__(self, limit: float = 2.5) -> None:
        self.limit = limit


@pytest.mark.parametrize("call", [conflow.train, conflow.compare, conflow.DescentPlanner.of])
@pytest.mark.parametrize("name", ["limit", "nonsense"])
def test_what_a_task_is_made_with_is_refused_beside_an_object_of_it(call: Callable[..., Any], name: str) -> None:
    """It would be recorded, and the object trained with what it has."""
    with pytest.raises(ConfigError) as refused:
        call(task=Limited(), **{f"task__{name}": 9.0})
    assert str(refused.value) == f"task.{name}=9.0: expected in the task object itself, Limited(limit=...)"


FUTURE = """
from __future__ import annotations
from dataclasses import dataclass

@dataclass
class Room:
    width: float = 1.0
"""


@pytest.mark.parametrize(
    "content",
    [
        COMPLETE,
        COMPLETE + "Alias = Mine\n",
        FUTURE + COMPLETE,
        COMPLETE + "    offset = 3\n",
        COMPLETE + "    offset = (3.0, -2)\n",
        COMPLETE + "    offset = torch.tensor([3.0, -2.0])\n",
        "from conflow.scene.tasks.swap import Swap\n" + COMPLETE,
    ],
    ids=[
        *("plain", "a second name", "a dataclass", "one offset", "an offset each", "a tensor of offsets"),
        "beside an imported task",
    ],
)
def test_a_file_with_a_task_gives_it(content: str, tmp_path: Path) -> None:
    path = tmp_path / "secrets.py"  # which must not stand in the way of the standard library's
    path.write_text(content)
    task = task_of_file(path)
    assert (task.name, task.robots.count, list(task.constraints())) == ("mine", 1, ["walls"])
    assert file_of(task) == str(path)
    assert "secrets" not in sys.modules or sys.modules["secrets"].__file__ != str(path)


def test_a_file_s_task_is_made_with_settings_of_its_own(tmp_path: Path) -> None:
    """Those that its constructor names; they belong to what the experiment is."""
    path = tmp_path / "mine.py"
    path.write_text(COMPLETE + "    def __init__(self, width: float = 1.0, label='a'): self.width = width\n")
    settings = config.load([f"task={path}", "task.width=2"])
    task = build_task(settings)
    assert (task.name, vars(task)) == ("mine", {"width": 2})
    assert settings.sha() != config.load([f"task={path}"]).sha()
    with pytest.raises(ConfigError, match=r"^task\.widht=2: no such setting of task mine, expected one of width, lab"):
        build_task(config.load([f"task={path}", "task.widht=2"]))


def test_a_run_is_loaded_with_the_settings_that_its_task_was_made_with(tmp_path: Path) -> None:
    """And one from before there was a setting has its default."""
    path = tmp_path / "mine.py"
    path.write_text(COMPLETE + "    def __init__(self, width: float = 1.0): self.width = width\n")
    settings = config.load([f"task={path}", "ablation=plus", "preset=smoke", "task.width=2"])
    trained = Training(settings, build_task(settings))
    checkpoint: dict[str, Any] = {"state_dict": trained.state_dict()}
    trained.on_save_checkpoint(checkpoint)
    del checkpoint["conflow"]["config"]["sample"]["descent"]
    torch.save(checkpoint, tmp_path / "model.ckpt")
    model = load_model(tmp_path / "model.ckpt", task=task_of_file(path))
    assert vars(model.task)["width"] == 2
    assert model.config == settings


@pytest.mark.parametrize("offset", [np.float32(3), np.array([3.0, -2.0]), torch.tensor([3.0, -2.0]), (3, -2.0), 3])
def test_a_checkpoint_holds_an_offset_of_any_kind_as_plain_numbers(offset: Any, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(COMPLETE)
    settings = config.load([f"task={tmp_path / 'mine.py'}", "ablation=plus", "preset=smoke"])
    task = build_task(settings)
    task.offset, checkpoint = offset, {"conflow": None}
    Training(settings, task).on_save_checkpoint(checkpoint)
    torch.save(checkpoint, tmp_path / "model.ckpt")
    loaded = torch.load(tmp_path / "model.ckpt", weights_only=True)["conflow"]
    assert loaded["offset"] == ([3.0, -2.0] if np.ndim(offset) else 3.0)


def test_a_changed_file_gives_the_changed_task(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    for count in (1, 2):
        path.write_text(COMPLETE.replace("Discs(1)", f"Discs({count})") + f"# {count * 'x'}\n")
        assert task_of_file(path).robots.count == count


def test_a_file_is_chosen_by_the_setting_and_waypoints_and_numbers_are_its_own(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(COMPLETE)
    settings = config.load([f"task={path}"])
    assert build_task(settings, 99, 8).robots.D == 2
    assert build_task(settings, 99, 8).T == 32
