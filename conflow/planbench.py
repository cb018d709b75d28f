"""`make planbench`: scene by scene, how soon is there one plan for all robots, and what does a model add to descent?

Candidates, so many at a time, descend on what is to be kept until one of them is feasible. With a model and without,
methods differ in where candidates come from, and in nothing else. All run on the same scenes, in the same process.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import count
from pathlib import Path
from statistics import mean, median

import torch
from rich.console import Console
from torch import Tensor

from conflow import commandline
from conflow.errors import ConfigError, brief
from conflow.figures.planbench import animation, success
from conflow.figures.workspace import DPI
from conflow.orca import Crossing, Simulator
from conflow.planner import exact, looks
from conflow.results import planbench as results
from conflow.results.planbench import Record, Row, Settings
from conflow.results.printing import checked_format
from conflow.scene.constraint import Sum
from conflow.scene.crowd import CrowdAvoidance
from conflow.scene.measures import keeps, leaves_workspace, path_length, smoothness
from conflow.scene.task import SceneTask
from conflow.scene.tasks import CROWDS
from conflow.scene.tasks.crowd import CrowdTask
from conflow.tracking import store
from conflow.tracking.recording import hardware
from conflow.training.build import NONE, build_source, build_task, descending, random_stream
from conflow.training.config import Config, load
from conflow.training.metrics import EnergyDistance
from conflow.training.model import ConFlow
from conflow.training.model_file import MODEL_FILE, load_model
from conflow.training.progress import ProgressDisplay

ENDS = 1e-5
"""Within this of its start and goal, in workspace units, a plan reaches them."""
ADHERENCE = 0.1
"""A waypoint this near to the straight line, as a share of its length, keeps to it (MMD's measure for empty maps)."""
AT_MOST = 2000
"""Single robots' trajectories that the energy distance is taken of."""

Propose = Callable[[SceneTask, Tensor, int, int], Tensor]
"""Candidates (num, T, D) for the task in a scene, start and goal (2, D), how many, and a seed."""
Solve = Callable[[SceneTask, Tensor, int], tuple[Tensor | None, float]]
"""A feasible plan (T, D), or None, and the seconds it took, for the task in a scene, start and goal, and a seed."""


@dataclass(frozen=True)
class Method:
    """What solves scenes.

    Attributes:
        name: in tables.
        solve: a scene.
        propose: what it descends from, where it does.
        raw: the same without guidance.
    """

    name: str
    solve: Solve
    propose: Propose | None = None
    raw: Propose | None = None


def of_model(name: str, model: ConFlow, config: Config, settings: Settings) -> Method:
    """Candidates of a trained model: its flow, from its own source, with guidance where `settings` asks for it.

    A network that was trained without a scene's map, or with another radius, meets them here, as it meets more robots.
    """
    on = lru_cache(maxsize=1)(model.on)

    def proposed(guided: bool) -> Propose:
        def propose(task: SceneTask, ends: Tensor, num: int, seed: int) -> Tensor:
            here, y = on(task), ends.expand(num, -1, -1)
            x_0 = here.source.sample(y, random_stream("planbench", seed))
            setting = next(iter(task.settings())) if guided else NONE
            return exact(here.source, here.flow(x_0, setting, y), y)

        return propose

    guided, raw = proposed(True), proposed(False)
    return Method(name, descending_from(guided if settings.guided else raw, config, settings), guided, raw)


def without_model(config: Config, settings: Settings) -> Method:
    """Candidates that are new demonstrations, of single robots and put together: descent does all the work."""

    def propose(task: SceneTask, ends: Tensor, num: int, seed: int) -> Tensor:
        return task.between(ends.expand(num, -1, -1), random_stream("planbench", seed))

    return Method("descent, no model", descending_from(propose, config, settings), propose, propose)


def descending_from(propose: Propose, config: Config, settings: Settings) -> Solve:
    """Candidates descend until one of them is feasible; after a while others are drawn."""
    source = build_source(config.source, build_task(config).T)

    @torch.no_grad()
    def solve(task: SceneTask, scene: Tensor, seed: int) -> tuple[Tensor | None, float]:
        began = time.perf_counter()
        u_c = descending(config, task, source)
        for x in looks(lambda draw: propose(task, scene, settings.num, seed + draw), u_c):
            good = feasible(task, x, scene.expand(len(x), -1, -1))
            seconds = time.perf_counter() - began
            if bool(good.any()) or seconds > settings.limit:
                break
        return (x[int(good.nonzero()[0])] if bool(good.any()) else None), seconds

    return solve


def orca(settings: Settings) -> Method:
    """Reciprocal collision avoidance: another try follows a failed one, until the time is over.

    Raises:
        ModuleNotFoundError: `pyrvo` is not installed.
    """
    simulate = Simulator()

    def solve(task: SceneTask, scene: Tensor, seed: int) -> tuple[Tensor | None, float]:
        assert isinstance(task, CrowdTask)
        start, goal = scene.unflatten(1, (-1, 2)).double().numpy()
        began = time.perf_counter()
        for attempt in count():
            left = settings.limit - (time.perf_counter() - began)
            if left <= 0:
                break
            # Twice the time of a demonstration is enough to arrive.
            walk = Crossing(start, goal, task.robots.radius, task.boxes(), 2 * task.seconds, (seed, attempt))
            path = simulate(walk, left)
            x = None if path is None else torch.from_numpy(path).flatten(1).float()
            if x is not None and bool(kept(task, x[None])):
                return x, time.perf_counter() - began
        return None, time.perf_counter() - began

    return Method("ORCA (pyrvo)", solve)


def run(
    config: Config,
    models: Mapping[str, ConFlow],
    robots: int,
    scenes: int,
    seed: int,
    settings: Settings,
    display: ProgressDisplay,
) -> Record:
    """Solve scenes with every method in turn, so that a busy minute of the machine is all methods' minute.

    Args:
        config: of the task, and of the source and margin of descent, the same for all methods.
        models: by name.
        robots: how many.
        scenes: how many, the first of the seed's.
        seed: of scenes.
        settings: how scenes are solved.
        display: for progress.

    Raises:
        ConfigError: the task has no scenes of so many robots, or they find no room.
    """
    task = with_scenes(config, robots)
    try:
        asked = [(task.in_scene(robots, seed, i), task.scene(robots, seed, i)) for i in range(scenes)]
    except ValueError as error:
        raise ConfigError(f"task {config.task}: {error}") from None
    methods = [without_model(config, settings)]
    methods += [of_model(name, model, config, settings) for name, model in models.items()]
    if isinstance(task, CrowdTask):
        with suppress(ModuleNotFoundError):  # named as missing where the table is printed
            methods.append(orca(settings))
    rows, plans = [Row(method.name) for method in methods], [list[Tensor]() for _ in methods]
    bar = display.add(f"{config.task} {robots}", scenes)
    for index, (made, scene) in enumerate(asked):
        for i in range(len(methods)):
            k = (i + index) % len(methods)  # none is always the first
            plan, seconds = methods[k].solve(made, scene, 1000 * index)
            rows[k].seconds.append(seconds)
            rows[k].passed.append(plan is not None)
            plans[k] += [] if plan is None else [plan]
        display.update(bar, index + 1, "solved " + ", ".join(str(row.solved) for row in rows))
    # Of other scenes, so that nothing of theirs is in the plans.
    others = [(task.in_scene(robots, seed + 1, i), task.scene(robots, seed + 1, i)) for i in range(scenes)]
    singles = [
        made.between(scene[None], random_stream("planbench law", seed, i)) for i, (made, scene) in enumerate(others)
    ]
    law = _by_robot(torch.cat(singles), robots)[:AT_MOST]
    for method, row, found in zip(methods, rows, plans, strict=True):
        _look(row, method, asked[: settings.looked], settings.num)
        _measure(row, task, found, law)
    shown = next((found[0] for found in reversed(plans) if found and len(found[0]) == task.T), torch.empty(0, 0))
    rounded = [[round(value, 4) for value in waypoint] for waypoint in shown.tolist()]
    return Record(config.task, robots, seed, asdict(settings), hardware(), rows, rounded)


def with_scenes(config: Config, robots: int) -> SceneTask:
    """The task that the config names, with so many robots.

    Raises:
        ConfigError: it has no scenes.
    """
    task = build_task(config)
    made = task.of_numbers(2 * robots)
    if not isinstance(made, SceneTask):
        raise ConfigError(f"task={config.task}: expected a task of many robots or of arms, such as weave")
    return made


def feasible(task: SceneTask, x: Tensor, ends: Tensor) -> Tensor:
    """The audit: nothing touches on the way, straight from waypoint to waypoint; inside; ends reached; (batch,)."""
    at_ends = (x[:, [0, -1]] - ends).abs().flatten(1).amax(dim=1) <= ENDS
    return at_ends & kept(task, x)


def kept(task: SceneTask, x: Tensor) -> Tensor:
    """Whether trajectories (batch, any T, D) keep all that the task asks for, and stay inside, boolean (batch,)."""
    return ~leaves_workspace(x) & keeps(Sum([*task.constraints().values()]), x)


@torch.no_grad()
def _look(row: Row, method: Method, asked: Sequence[tuple[SceneTask, Tensor]], num: int) -> None:
    """What candidates are worth before descent."""
    if method.propose is None or method.raw is None:
        return
    conflicts: list[float] = []
    for index, (task, scene) in enumerate(asked):
        y = scene.expand(num, -1, -1)
        guided, raw = (propose(task, scene, num, 1000 * index) for propose in (method.propose, method.raw))
        row.guided_feasible += int(feasible(task, guided, y).sum())
        row.raw_feasible += int(feasible(task, raw, y).sum())
        if isinstance(task, CrowdTask):
            conflicts += (CrowdAvoidance(task.robots).clearances(raw).amin(dim=1) < 0).sum(dim=1).tolist()
    row.raw = row.guided = num * len(asked)
    row.conflicts = mean(conflicts) if conflicts else None


def _measure(row: Row, task: SceneTask, plans: Sequence[Tensor], law: Tensor) -> None:
    """How good the plans of solved scenes are, and how far from single robots' (n, T, D / robots).

    Those of a simulation last as long as they do, so only their paths are measured.
    """
    if not plans:
        return
    row.path_length = median(float(path_length(task.robots, x[None])) for x in plans)
    if isinstance(task, CrowdTask):
        away = [_from_line(_by_robot(x[None], task.robots.count)) for x in plans]
        row.adherence = mean(float((one <= ADHERENCE).float().mean()) for one in away)
    if any(len(x) != task.T for x in plans):
        return
    x = torch.stack(list(plans))
    row.smoothness = float(smoothness(task.robots, x).median())
    distance = EnergyDistance(law)
    distance.update(_by_robot(x, task.robots.count)[:AT_MOST])
    found = distance.compute()
    row.energy_distance = [found[f"energy_distance{part}"] for part in ("", "_low", "_high")]


def _by_robot(x: Tensor, robots: int) -> Tensor:
    """Trajectories (batch, T, D) of single robots, (batch robots, T, D / robots)."""
    return x.unflatten(2, (robots, -1)).transpose(1, 2).flatten(0, 1)


def _from_line(x: Tensor) -> Tensor:
    """How far waypoints of trajectories (batch, T, 2) are from the straight line, in its lengths, (batch, T)."""
    start, travel = x[:, :1], x[:, -1:] - x[:, :1]
    away = x - start
    cross = away[..., 0] * travel[..., 1] - away[..., 1] * travel[..., 0]
    return cross.abs() / travel.square().sum(dim=2)


def _folder(out: str) -> Path:
    """The folder for records, made where it is missing."""
    try:
        Path(out).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"out={brief(out)}: {error.strerror}, expected a folder") from None
    return Path(out)


def _models(options: Mapping[str, str], arguments: Sequence[str], task: SceneTask, guided: bool) -> dict[str, ConFlow]:
    """The models of the runs that the option `run` names, by what tables call them.

    Raises:
        ConfigError: one of a task that is too different, or one that was named before.
    """
    found = []
    for name in options["run"].split(","):
        model = load_model(store.artifact(store.find_run(name), MODEL_FILE), arguments)
        taken = model.config
        if taken.task != options["task"] and not (isinstance(task, CrowdTask) and taken.task in CROWDS):
            crowds = " or another one of many robots" if isinstance(task, CrowdTask) else ""
            raise ConfigError(f"run={name}: is of task {taken.task}, expected {options['task']}{crowds}")
        learned = "" if taken.task == options["task"] else f"{taken.task}-"
        solver = "" if taken.sample.solver == "euler" else f"{taken.sample.solver} "
        steps = f"{taken.sample.steps} {solver}steps{', guided' * guided}"
        found.append((name, f"{learned}{taken.ablation}-s{taken.seed}, {steps}", model))
    labels = [label for _, label, _ in found]
    models: dict[str, ConFlow] = {}
    for name, label, model in found:
        own = label if labels.count(label) == 1 else f"{model.config.preset}/{label}"
        if own in models:
            raise ConfigError(f"run={name}: found {own} twice, expected once")
        models[own] = model
    return models


def planbench(options: Mapping[str, str], arguments: Sequence[str], console: Console) -> None:
    """Run the benchmark as the command line asks, print, write and draw what came of it; or print what is of record.

    Args:
        options: task, n, scenes, run, seed, num, limit, guided, format, reference and out.
        arguments: settings `sample....=value` of the models.
        console: for progress and the table.

    Raises:
        ConfigError: an option that cannot be used, or runs that cannot be compared.
    """
    form = checked_format(options["format"])
    if commandline.whole(options, "reference", 0, 1):
        results.render(results.of_reference(), form, console)
        return
    named = load([f"task={options['task']}", "ablation=plus"])
    robots = commandline.whole(options, "n", 2, 1000) if options["n"] else build_task(named).robots.count
    scenes = commandline.whole(options, "scenes", 1, 10**5)
    seed, num = commandline.whole(options, "seed", 0, 2**32 - 1), commandline.whole(options, "num", 1, 10**4)
    guided = commandline.whole(options, "guided", 0, 1) == 1
    settings = Settings(num, commandline.number(options, "limit"), guided)
    task = with_scenes(named, robots)
    if options["run"] == "none":
        commandline.options(arguments, options, settings=False)  # settings are a model's
    models = {} if options["run"] == "none" else _models(options, arguments, task, guided)
    folder = _folder(options["out"])  # now, and not when everything is solved
    with ProgressDisplay(console) as display:
        record = run(named, models, robots, scenes, seed, settings, display)
    results.render([record], form, console)
    path = results.write(record, folder)
    attempts = {row.method: (row.seconds, row.passed) for row in record.rows}
    success(record.task, record.robots, attempts).savefig(path.with_suffix(".png"), dpi=DPI)
    if record.plan and isinstance(task, CrowdTask):
        boxes = task.in_scene(robots, seed, 0).boxes()
        animation(torch.tensor(record.plan), task.robots.radius, boxes, path.with_suffix(".gif"))
    print(f"Written: {path}, and pictures beside it", file=sys.stderr)
