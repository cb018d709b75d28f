"""From settings to the objects of `flow/` and `scene/`: the one place where a name becomes a class."""

import hashlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from conflow.errors import ConfigError, brief, nearest
from conflow.flow import settings as of_flow
from conflow.flow import source
from conflow.flow.attention import HEADS, SpectralAttention
from conflow.flow.correction import Correction, covariant, descend, gaussian_filter
from conflow.flow.network import ResMLP, Spectral, SpectralMLP
from conflow.flow.sampler import in_pieces
from conflow.flow.source import Source
from conflow.scene.constraint import Barrier, Constraint, Sum, Workspace
from conflow.scene.robots import Crowd, Discs
from conflow.scene.task import Task
from conflow.scene.tasks import SWAPS, TASKS
from conflow.training import config
from conflow.training.config import Config

NONE = "none"
"""The setting without guidance; the others are the task's."""
REFINED = "refined"
"""The setting guided around all that training keeps, with `sample.descent` steps of descent after the flow."""


def build_task(settings: Config, T: int | None = None, D: int = 4) -> Task:
    """The task of these settings.

    Args:
        settings: of the experiment.
        T: waypoints, where the demonstrations have them and not the settings.
        D: numbers of a configuration, likewise.

    Raises:
        ConfigError: it is a file of which no task can be had.
    """
    if config.is_file(settings.task):
        return task_of_file(Path(settings.task), settings.of_task)
    if settings.task not in SWAPS:
        return made(TASKS[settings.task], settings.task, settings.of_task)
    for name, value in settings.of_task.items():
        raise ConfigError(f"task.{name}={brief(value)}: task {settings.task} has no settings of its own")
    return SWAPS[settings.task](
        T or settings.data.horizon,
        D,
        settings.constraint.radius,
        settings.sample.obstacle,
        settings.sample.radius,
        settings.sample.object_radius,
        settings.data.amplitudes,
        settings.data.jitter,
    )


def made(kind: Callable[..., Task], name: str, of_task: Mapping[str, Any]) -> Task:
    """A task of a class, made with settings of its own.

    Raises:
        ConfigError: it takes no such argument, or refuses a value.
    """
    takes = settings_of(kind)
    for one, value in of_task.items():
        if one not in takes:
            expected = f"expected one of {', '.join(takes)}{nearest(one, takes)}" if takes else "it takes none"
            raise ConfigError(f"task.{one}={brief(value)}: no such setting of task {name}, {expected}")
    try:
        return kind(**of_task)
    except ValueError as error:
        raise ConfigError(f"task {name}: {error}") from None


def settings_of(kind: Callable[..., Task]) -> list[str]:
    """The settings of its own that a task is made with, `task.NAME`: the arguments that its constructor names."""
    return [one for one in inspect.signature(kind).parameters if one not in ("args", "kwargs")]


def task_of_file(path: Path, of_task: Mapping[str, Any] = MappingProxyType({})) -> Task:
    """The task that a Python file defines: runs the file, and makes its one subclass of `Task` with its own settings.

    Raises:
        ConfigError: there is no such file, it is called as a named task is, it fails, or it has none or several.
    """
    config.check_file(str(path))
    if not path.is_file():
        raise ConfigError(f"task={brief(path)}: no such file, expected a Python file that defines a Task")
    spec = importlib.util.spec_from_file_location(f"conflow_task_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # where dataclasses look for it
    try:
        spec.loader.exec_module(module)
        kinds = {id(kind): kind for kind in vars(module).values() if isinstance(kind, type) and issubclass(kind, Task)}
        found = [kind for kind in kinds.values() if kind.__module__ == spec.name]
        if len(found) != 1:
            names = ", ".join(kind.__name__ for kind in found) or "none"
            raise ConfigError(f"task={brief(path)}: expected one class that is a conflow.Task, found {names}")
        if missing := sorted(getattr(found[0], "__abstractmethods__", ())):
            raise ConfigError(f"task={brief(path)}: expected {found[0].__name__} to define {', '.join(missing)}")
        return checked(made(found[0], path.stem, of_task), brief(path))
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:  # somebody else's code may fail in any way, or end
        raise ConfigError(f"task={brief(path)}: {type(error).__name__}: {brief(error)}") from error


def of_object(task: Task, settings: Config) -> Task:
    """A task that came as an object, checked.

    Raises:
        ConfigError: what it lacks; or settings of its own beside it, which it was made without.
    """
    for name, value in settings.of_task.items():
        takes = ", ".join(f"{one}=..." for one in settings_of(type(task)))
        expected = f"expected in the task object itself, {type(task).__name__}({takes})"
        raise ConfigError(f"task.{name}={brief(value)}: {expected}")
    return checked(task, task.name)


def checked(task: Task, name: str) -> Task:
    """A task, as it came, if it has what every task has.

    Raises:
        ConfigError: what it lacks.
    """
    if not hasattr(task, "robots"):
        raise ConfigError(f"task={name}: expected an attribute robots, such as conflow.Discs(count=1, radius=0.05)")
    for what, value in (("scale", task.scale), ("offset", task.offset)):
        if not _fits(value, task.robots.D):
            expected = f"expected a number, or {task.robots.D}, one for each of a configuration"
            raise ConfigError(f"task={name}: {what}={brief(value)}: {expected}")
    trained, at_inference = {*task.constraints()}, {*task.constraints_at_inference()}
    known = trained | at_inference
    if not trained:
        raise ConfigError(f"task={name}: expected a constraint in constraints(), found none")
    for one in (*known, *task.settings()):
        # They become parts of metrics' names, and of a torch module.
        if not isinstance(one, str) or not re.fullmatch(r"[\w-]+", one) or hasattr(torch.nn.ModuleDict(), one):
            expected = "expected a name of letters, digits, _ and -, other than torch's own"
            raise ConfigError(f"task={name}: {brief(one)}: {expected}")
        if one in (NONE, REFINED):
            expected = f"expected another name than {NONE} and {REFINED}, which are settings of every task"
            raise ConfigError(f"task={name}: {one}: {expected}")
    if twice := sorted(trained & at_inference):
        raise ConfigError(f"task={name}: expected other names at inference, found {', '.join(twice)}")
    for setting, guided in task.settings().items():
        for constraint in guided:
            if constraint not in known:
                expected = f"expected names of constraints, {', '.join(sorted(known))}"
                raise ConfigError(f"task={name}: setting {setting} guides around {constraint}, {expected}")
    for one, judged in task.judged().items():
        _check_answers(judged, torch.zeros(2, task.T, task.robots.D), f"task={name}: constraint {one}")
    return task


def _check_answers(constraint: Constraint, x: Tensor, name: str) -> None:
    """Refuse a constraint that does not say of trajectories x (batch, T, D) what every constraint says.

    Between waypoints too: by default that asks for the clearance at many more of them.

    Raises:
        ConfigError: names what it was asked for, what came and what was expected.
    """
    batch, T, _ = x.shape
    for asked, shape in (("clearance", (batch, T)), ("swept_clearance", (batch, T - 1)), ("closest", (batch,))):
        try:
            c = getattr(constraint, asked)(x)
            if c.shape == shape and c.is_floating_point():
                continue
            found = f"{c.dtype} of shape {tuple(c.shape)}"
        except Exception as error:  # somebody else's code may fail in any way
            found = f"{type(error).__name__}: {brief(error)}"
        expected = f"expected floating-point numbers of shape {shape}"
        expected += ", from clearance at any number of waypoints" * (asked != "clearance")
        raise ConfigError(f"{name}: {asked} of x {tuple(x.shape)}: found {found}, {expected}")


def _fits(value: Any, D: int) -> bool:
    """Whether a scale or an offset is a number, or D of them."""
    try:
        shape = torch.as_tensor(value, dtype=torch.float32).shape
    except (TypeError, ValueError, RuntimeError):
        return False
    return shape in ((), (D,))


def file_of(task: Task) -> str:
    """The file that defines a task, or its name with .py where there is none, as in a notebook."""
    try:
        path = Path(inspect.getfile(type(task)))
    except (OSError, TypeError):
        return f"{task.name}.py"
    return str(path) if path.suffix == ".py" and path.is_file() else f"{task.name}.py"


def build_source(chosen: of_flow.Source, T: int) -> Source:
    """The source p_0 on T waypoints."""
    if chosen.kind == "gaussian":
        return source.gaussian(T, chosen.modes)
    process = source.cgp if chosen.kind == "cgp" else source.gp
    return process(T, chosen.length_scale, chosen.sigma_f, chosen.epsilon, chosen.modes)


def fitted(settings: Config, demonstrations: Tensor) -> Config:
    """The settings with the kernel most likely for demonstrations (N, T, D), where `source.fit` asks for it.

    Raises:
        ConfigError: there is none.
    """
    if not settings.source.fit:
        return settings
    index = build_source(settings.source, demonstrations.shape[1]).index.tolist()
    try:
        length_scale, sigma_f = source.fit_rbf(demonstrations, index, settings.source.epsilon)
    except ValueError as error:
        raise ConfigError(f"source.fit=True: {error}") from None
    return replace(settings, source=replace(settings.source, length_scale=length_scale, sigma_f=sigma_f))


def barrier(settings: Config) -> Barrier:
    """C as a function of the clearances."""
    constraint = settings.constraint
    return Barrier(constraint.barrier, constraint.reduction, constraint.gamma, constraint.pairs)


def joined(constraints: Sequence[Constraint]) -> Constraint:
    """Several constraints as one."""
    return constraints[0] if len(constraints) == 1 else Sum(constraints)


def labels(settings: Config, task: Task) -> Constraint:
    """What demonstrations are labelled by: all that training keeps."""
    return joined([one.shaped(barrier(settings)) for one in task.constraints().values()])


def kept(settings: Config, task: Task) -> Constraint:
    """What training corrects for and guidance keeps: the same with the margin and, where asked for, the walls."""
    margin, shape = settings.correction.margin, barrier(settings)
    terms = [one.shaped(shape, margin) for one in task.constraints().values()]
    return joined([*terms, Workspace(task.robots).shaped(shape, margin)] if settings.correction.walls else terms)


def build_correction(chosen: of_flow.Correction, constraint: Constraint, source: Source) -> Correction:
    """u^c of a constraint, smoothed as the settings say."""
    if chosen.smoothing == "covariant":
        return Correction(constraint, covariant(source.covariance))
    smoothing = gaussian_filter(len(source.prior), chosen.sigma, chosen.width, chosen.edges)
    if chosen.keep_ends:
        smoothing[source.index] = 0
    return Correction(constraint, smoothing)


def build_network(chosen: of_flow.Network, source: Source, task: Task, constraint: Constraint) -> ResMLP | Spectral:
    """The velocity network v_theta.

    Raises:
        ConfigError: it is none for these robots.
    """
    robots = task.robots
    if chosen.kind == "resmlp":
        if len(counts := sorted({variant.robots.count for variant in task.variants()})) > 1:
            found = f"found {', '.join(map(str, counts))} in turn; try task.robots={counts[-1]}, or ABLATION=plus"
            raise ConfigError(f"network.kind=resmlp: expected robots of one number, {found}")
        return ResMLP(len(source.prior), robots.D, chosen.hidden, chosen.blocks, chosen.sees_ends)
    if chosen.kind == "spectral" and not isinstance(robots, Crowd):
        return SpectralMLP(source, robots.D, constraint, chosen.hidden, chosen.blocks)
    if not isinstance(robots, Discs):
        raise ConfigError(f"network.kind={chosen.kind}: expected robots that are discs, found {type(robots).__name__}")
    if chosen.hidden % HEADS:
        raise ConfigError(f"network.hidden={chosen.hidden}: expected a multiple of {HEADS}, the heads of attention")
    each = robots.D // robots.count
    return SpectralAttention(source, each, constraint, robots.apart, chosen.hidden, chosen.blocks)


REPAIR_STEPS, MOMENTUM = 100, 0.7
"""Of descent: steps that mend demonstrations, and how much of a step the next one keeps."""


def descending(settings: Config, task: Task, source: Source, more: Sequence[Constraint] = ()) -> Correction:
    """The correction that `descent` follows: of all that training keeps, with its margin, by the square barrier.

    Args:
        settings: for margin and walls.
        task: what is kept.
        source: along whose covariance trajectories move.
        more: constraints beside those of the task.
    """
    shape, margin = Barrier("square", pairs="all"), settings.correction.margin
    terms = [one.shaped(shape, margin) for one in (*task.constraints().values(), *more)]
    # A little inside the walls, so that rounding leaves nothing outside.
    walls = [Workspace(task.robots).shaped(shape, margin)] if settings.correction.walls else []
    return Correction(joined([*terms, *walls]), covariant(source.covariance))


def repaired(settings: Config, task: Task, x: Tensor) -> Tensor:
    """Demonstrations x (N, T, D), those in violation moved out of it by the margin, along the CGP's covariance.

    Along that one whatever the source is, so that all sources are shown the same.
    """
    u_c = descending(settings, task, build_source(replace(settings.source, kind="cgp"), x.shape[1]))
    return in_pieces(lambda piece: descend(piece, u_c, REPAIR_STEPS, MOMENTUM), x)


def random_stream(*key: str | int, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator that is a function of what its numbers are for, such as ("batch", seed, step).

    No state is carried from one use to the next, so a run that was interrupted draws what it would have drawn.
    """
    digest = hashlib.sha256(repr(key).encode()).digest()
    return torch.Generator(device).manual_seed(int.from_bytes(digest[:8], "big") >> 1)
