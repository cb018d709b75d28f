"""The public face for other programs: load a run, plan trajectories between starts and goals.

    plans = Planner.load("latest").plan(start=(-0.8, 0, 0.8, 0), goal=(0.8, 0, -0.8, 0))
    best, clearance = plans.x[0], plans.clearance[0]

Or without a model: `DescentPlanner.of("swap")` instead.

With a `model.ckpt` in place of a run in the store it needs torch and numpy alone.
"""

import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import accumulate, count, islice
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from conflow.errors import ConfigError, brief, nearest
from conflow.flow.correction import Correction, descend, descent
from conflow.flow.sampler import in_pieces, integrate
from conflow.flow.source import Source
from conflow.scene.constraint import Constraint, Sum
from conflow.scene.measures import leaves_workspace, smoothness
from conflow.scene.robots import Crowd
from conflow.scene.settings import Ball, Obstacle
from conflow.scene.task import SceneTask, Task, demonstrated, told
from conflow.scene.tasks import TASKS
from conflow.tracking.checkpoint_file import CheckpointError
from conflow.training import config
from conflow.training.build import (
    MOMENTUM,
    NONE,
    REPAIR_STEPS,
    barrier,
    build_task,
    descending,
    fitted,
    of_object,
    random_stream,
)
from conflow.training.config import Range
from conflow.training.memory import check_memory
from conflow.training.model import ConFlow, start_and_goal
from conflow.training.model_file import MODEL_FILE, load_model

ALL, AROUND_OBSTACLES = "all", "obstacle"
CHECKED, ROUNDS = 5, 12
"""Steps of descent between two looks at candidates, and looks until others are drawn."""
FITTED_TO = 1000
"""Demonstrations that a source is fitted to where there is no model."""
FAR = 100
"""From so many times its size away on, a workspace has too few places in float32: every half metre in those of UTM."""
Numbers = ArrayLike | Tensor
ViaPoint = tuple[float, Numbers]
Flow = Callable[[Tensor, Tensor], Tensor]
"""Where samples x_0 of the source (num, T, D) come to, for starts and goals (num, 2, D)."""


class PlanError(ConfigError):
    """A run, a request or a file that cannot be used: what was given and what was expected, in one line."""


@dataclass(frozen=True, eq=False)
class Plans:
    """Trajectories and how good they are: feasible ones first, each group from the smoothest on.

    Attributes:
        x: (B, num, T, D) in the user's units, or (num, T, D) for a single pair; likewise below. In float64 where the
            workspace is `FAR` from the user's origin.
        clearance: the smallest on the way, straight from waypoint to waypoint, over what training keeps and the
            obstacles given, (B, num).
        feasible: nothing is violated on the way, and all of it is inside the workspace; boolean (B, num).
        smoothness: mean norm of the second difference of the bodies' positions, (B, num); smaller is smoother.
    """

    x: Tensor
    clearance: Tensor
    feasible: Tensor
    smoothness: Tensor

    def __getitem__(self, which: int | slice) -> "Plans":
        """The plans of one pair; of a single pair the plans of a slice."""
        return Plans(*(getattr(self, field.name)[which] for field in fields(self)))


class Planner:
    """Plans with a trained model.

    Args:
        model: on the CPU.

    Attributes:
        scale, offset: the user's coordinates are `scale` x + `offset`, with x in workspace units, (D,) each.
        length, origin: likewise `length` p + `origin` of bodies at p, where a configuration is not their positions.
    """

    def __init__(self, model: ConFlow) -> None:
        self.model = model.eval()
        scale, offset = (self._each(name, getattr(model.task, name)) for name in ("scale", "offset"))
        far = bool((offset.abs() > FAR * scale).any())
        self.scale, self.offset = (units if far else units.float() for units in (scale, offset))
        self.length, self.origin = model.task.length, model.task.origin

    @classmethod
    def load(cls, run: str | Path = "latest", task: Task | None = None) -> "Planner":
        """The planner of a run: "latest", its id, NAME, PRESET/NAME, or the path of a `model.ckpt`, without a store.

        Only weights and plain values are read; no code in the file is executed. So a run on a task of one's own needs
        the task here too; one on a task with a name takes no other.

        Raises:
            PlanError: there is no such run or file, the store cannot be used, the file is damaged or no run's
                `model.ckpt`, or the task is missing or not the run's. What the task itself raises comes as it is.
        """
        path = _checkpoint(run)
        try:
            # Of a foreign file torch says a word of warning before it refuses it.
            with warnings.catch_warnings(action="ignore"):
                return cls(load_model(path, task=task))
        except FileNotFoundError as error:
            if error.filename != str(path):  # but one that the task reads
                raise
            raise PlanError(f"run={run}: no such file, expected the {MODEL_FILE} of a run") from None
        except CheckpointError:
            raise PlanError(
                f"run={run}: expected the {MODEL_FILE} of a run of this version, found a damaged or foreign file"
            ) from None
        except ConfigError as error:
            raise PlanError(f"run={run}: {error}") from None

    def plan(
        self,
        start: Numbers,
        goal: Numbers,
        num: int = 64,
        obstacles: Sequence[Obstacle | Sequence[float]] = (),
        via: Sequence[ViaPoint] = (),
        guidance: str | None = ALL,
        seed: int = 0,
        *,
        robot_weight: float | None = None,
        obstacle_weight: float | None = None,
        descent: int | None = None,
    ) -> Plans:
        """`num` trajectories x_1 for every pair of start and goal.

        x_0 ~ p(. | y), the run's source conditioned on y = (start, via-points, goal); x_1 is where the guided flow
        v + lambda_r u^c + lambda_o u^c_obstacles takes it, u^c being the correction of all that training keeps. Then
        `exact` makes it meet y to the last bit, and clearance and smoothness are those of the result. The noise depends
        on the seed alone, so a pair gets the same plans alone and, to rounding, in any batch.

        What the model has not seen it cannot promise. Via-points, and starts and goals unlike the demonstrations', are
        met all the same, but the flow between them is a guess. One that was trained from an unconditioned source ends
        where demonstrations end, wherever the goal is: `exact` then bends the whole trajectory to reach it (`gp`), or,
        W being a unit map, moves that waypoint alone and leaves a jump (`gaussian`). The smoothness shows it.

        Args:
            start: configurations, such as (x1, y1, x2, y2, ...), (D,) or (B, D), in the user's units.
            goal: likewise, as many as starts.
            num: trajectories per pair.
            obstacles: discs to avoid, each an `Obstacle` or (x, y, radius), in the user's units; of arms in space
                spheres, each a `Ball` or (x, y, z, radius). They are guided around and judged by; the network was not
                trained on them.
            via: (s, position (D,)) for all pairs alike; s, between 0 and 1, is moved to the nearest inner waypoint.
            guidance: "all": around what training keeps, and around obstacles where there are some; the name of a
                constraint of the training: around all of those alone; "obstacle": around the obstacles alone; "none" or
                None: the flow alone.
            seed: of the noise.
            robot_weight: lambda_r, where guidance uses it; the run's `sample.robot_weight` unless given.
            obstacle_weight: lambda_o, likewise.
            descent: steps of descent after the flow, around all that is to be kept; the run's `sample.descent` unless
                given. Trajectories that keep it with the run's margin stay as they are.

        Raises:
            PlanError: names the argument, its value and what was expected.
        """
        sized = self._sized(start)
        if sized is not self:
            weights = {"robot_weight": robot_weight, "obstacle_weight": obstacle_weight}
            return sized.plan(start, goal, num, obstacles, via, guidance, seed, descent=descent, **weights)
        steps = self.model.config.sample.descent if descent is None else _whole("descent", descent, low=0)
        num, seed = _whole("num", num, low=1), _whole("seed", seed, low=0)
        start, goal = self._configurations("start", start), self._configurations("goal", goal)
        if goal.shape != start.shape:
            raise PlanError(f"goal: found shape {tuple(goal.shape)}, expected that of start, {tuple(start.shape)}")
        points = {
            k: self._configurations(f"via[{i}]", position, batch=False)
            for i, (k, position) in enumerate(_via_points(via, self.model.T).items())
        }
        discs = self._discs(obstacles)
        met = self._met(discs)
        self._refuse_violation("start", start, 0, met)
        self._refuse_violation("goal", goal, -1, met)
        for i, (waypoint, point) in enumerate(points.items()):
            self._refuse_violation(f"via[{i}]", point, waypoint, met)

        y = torch.stack([start, *(point.expand_as(start) for point in points.values()), goal], dim=-2)
        y = y.reshape(-1, *y.shape[-2:])
        self._check_memory(num, len(y))
        arrive, index = self._flow(guidance, discs, robot_weight, obstacle_weight), (0, *points, -1)
        x = self._candidates(arrive, self._inside(y), index, num, seed)
        if steps:
            u_c = self._descending(discs, index)
            x = in_pieces(lambda x: descend(x, u_c, steps, MOMENTUM), x.flatten(0, 1)).view_as(x)
        plans = self._in_users_units(_ranked(x, Sum(list(met.values()))))
        plans.x[:, :, index] = y[:, None].to(plans.x)  # which on the way through workspace units may have lost a bit
        return plans if start.ndim == 2 else plans[0]

    def best_of(
        self,
        start: Numbers,
        goal: Numbers,
        num: int = 16,
        obstacles: Sequence[Obstacle | Sequence[float]] = (),
        seed: int = 0,
        *,
        seconds: float = 10.0,
        progress: Callable[[float, float], None] | None = None,
    ) -> Plans:
        """One feasible plan for a single pair, as soon as there is one: `num` candidates at a time, descending.

        Every CHECKED steps of descent the candidates are judged. After ROUNDS checks others are drawn, with the next
        seed.

        Args:
            start: configuration (D,), in the user's units.
            goal: likewise.
            num: candidates at a time.
            obstacles: as in `plan`.
            seed: of the noise.
            seconds: after which the best there is, feasible or not, is returned.
            progress: called after every check with the seconds so far and the best clearance.

        Raises:
            PlanError: as `plan`.
        """
        sized, began = self._sized(start), time.monotonic()
        ends = torch.stack([sized._configurations(*end, batch=False) for end in (("start", start), ("goal", goal))])
        seed, seconds = _whole("seed", seed, low=0), _number("seconds", seconds)
        given = _items("obstacles", obstacles)  # which may be there only once
        discs = sized._discs(given)
        met = Sum(list(sized._met(discs).values()))
        u_c = sized._descending(discs, (0, -1))

        def propose(draw: int) -> Tensor:
            x = sized.to_workspace(sized.plan(start, goal, num, given, seed=seed + draw, descent=0).x)
            x[:, [0, -1]] = sized._inside(ends)  # which on the way through the user's units may have left it by a bit
            return x

        tried = (_nearest(_ranked(x[None], met)[0]) for x in looks(propose, u_c))
        for best in accumulate(tried, _better):
            passed = time.monotonic() - began
            if progress:
                progress(passed, sized.length * float(best.clearance))
            if bool(best.feasible) or passed > seconds:
                break
        found = sized._in_users_units(best)
        found.x[:, [0, -1]] = ends.to(found.x)
        return found

    def _sized(self, start: Numbers) -> "Planner":
        """The planner for as many robots as a start (..., D) places: this one, unless its robots are a crowd."""
        if not isinstance(self.model.task.robots, Crowd):
            return self
        D = _numbers("start", start, "numbers of shape (D,) or (B, D)").shape[-1:]
        return self if D == () or D[0] < 4 or D[0] % 2 else self.of_numbers(D[0])

    def of_numbers(self, D: int) -> "Planner":
        """The planner for configurations of D numbers: this one, or of a crowd the same for as many robots."""
        model = self.model.of_numbers(D)
        return self if model is self.model else type(self)(model)

    def _met(self, discs: Sequence[Obstacle]) -> dict[str, Constraint]:
        """What plans are judged by: all that training keeps, and obstacles."""
        met = {name: self.model.judged[name] for name in self.model.task.constraints()}
        return met | {f"obstacles[{i}]": self._avoidance(disc) for i, disc in enumerate(discs)}

    def _descending(self, discs: Sequence[Obstacle], index: Sequence[int]) -> Correction:
        """The correction that descent follows: of all that training keeps and of obstacles, at rest at waypoints O."""
        task, config = self.model.task, self.model.config
        around = [task.avoidance([disc]) for disc in discs]
        return descending(config, task, self.model.source.condition(index), around)

    def _each(self, name: str, value: float | Sequence[float]) -> Tensor:
        """A number of the task's for each of D."""
        try:
            return torch.as_tensor(value, dtype=torch.float64).expand(self.model.D)
        except RuntimeError:
            expected = f"expected a number, or {self.model.D}, one for each of a configuration"
            raise PlanError(f"task {self.model.task.name}: {name}={brief(value)}: {expected}") from None

    def _in_users_units(self, plans: Plans) -> Plans:
        x = plans.x if self._in_workspace_units() else self.scale * plans.x + self.offset
        return Plans(x, self.length * plans.clearance, plans.feasible, self.length * plans.smoothness)

    def _in_workspace_units(self) -> bool:
        """Whether the user's units are those; then nothing is computed that could cost a bit."""
        return bool((self.scale == 1).all()) and not bool(self.offset.any())

    def to_workspace(self, x: Tensor) -> Tensor:
        """Configurations x (..., D) of the user's units in workspace units, in float32."""
        return (x if self._in_workspace_units() else (x - self.offset) / self.scale).float()

    def _inside(self, y: Tensor) -> Tensor:
        """Configurations y (..., D) that were checked, in workspace units, and not a bit outside."""
        return self.to_workspace(y).clamp(-1, 1)

    def _configurations(self, name: str, value: Numbers, batch: bool = True) -> Tensor:
        """Configurations (D,), with `batch` also (B, D), in the user's units and inside the workspace."""
        D = self.model.D
        expected = f"numbers of shape ({D},)" + f" or (B, {D})" * batch
        y = _numbers(name, value, expected)
        if y.ndim not in (1, 1 + batch) or y.shape[-1] != D or not len(y):
            raise PlanError(f"{name}={brief(value)}: found shape {tuple(y.shape)}, expected {expected}")
        low, high = self.offset - self.scale, self.offset + self.scale
        ranges = sorted(set(zip(low.tolist(), high.tolist(), strict=True)))
        where = (
            f"[{ranges[0][0]:g}, {ranges[0][1]:g}]"
            if len(ranges) == 1
            else f"{_text(low.tolist())} to {_text(high.tolist())}"
        )
        # In float32, so that what a user computed in it may stand on the border. Not a number is not inside either.
        outside = ~((y.float() >= low.float()) & (y.float() <= high.float())).all(dim=-1)
        _refuse(name, y, outside, f"expected finite numbers in the workspace {where}")
        return y

    def _discs(self, obstacles: Iterable[Obstacle | Sequence[float]]) -> list[Obstacle]:
        """Obstacles in workspace units."""
        return [self._disc(f"obstacles[{i}]", disc) for i, disc in enumerate(_items("obstacles", obstacles))]

    def _disc(self, name: str, disc: Obstacle | Sequence[float]) -> Obstacle:
        """An obstacle in the bodies' units."""
        found = _obstacle(name, disc)
        x, y = ((value - zero) / self.length for value, zero in zip((found.x, found.y), self.origin, strict=True))
        if isinstance(found, Ball):
            return Ball(x, y, found.radius / self.length, found.z / self.length)
        return Obstacle(x, y, found.radius / self.length)

    def _refuse_violation(self, name: str, y: Tensor, waypoint: int, met: Mapping[str, Constraint]) -> None:
        """Refuse configurations y (D,) or (B, D) that violate something at a waypoint: no plan with them is feasible.

        A constraint may be on more than the one waypoint, such as on its speed. So they are refused where they violate
        it with all others there too and with all others elsewhere.
        """
        still = self._inside(y).view(-1, 1, self.model.D).repeat(1, self.model.T, 1)
        elsewhere = torch.where(still > 0, -1.0, 1.0)
        elsewhere[:, waypoint] = still[:, waypoint]
        for what, constraint in met.items():
            clearance = constraint.clearance(still)[:, waypoint]
            violates = (clearance < 0) & (constraint.clearance(elsewhere)[:, waypoint] < 0)
            if bool(violates.any()):
                first = int(violates.nonzero()[0])
                by = f"{self.length * -float(clearance[first]):.3g}{_who(constraint, still[first, None], waypoint)}"
                _refuse(name, y, violates.view(y.shape[:-1]), f"violates {what} by {by}, expected not to")

    def _check_memory(self, num: int, pairs: int) -> None:
        """Refuse more plans than fit into memory: x_0, x_1, what is missing of y, and the result."""
        try:
            check_memory("num", num, 4 * 4 * num * pairs * self.model.T * self.model.D)
        except ConfigError as error:
            raise PlanError(str(error)) from None

    def _flow(
        self,
        guidance: str | None,
        obstacles: Sequence[Obstacle],
        robot_weight: float | None,
        obstacle_weight: float | None,
    ) -> Flow:
        """The ODE of the network's velocity field inside those of the guidance."""
        kept = [*self.model.task.constraints()]
        known = [*dict.fromkeys([NONE, ALL, *kept, AROUND_OBSTACLES])]
        if guidance is not None and guidance not in known:
            offer = nearest(str(guidance), known)
            raise PlanError(f"guidance={brief(guidance)}: expected one of {', '.join(known)}{offer}")
        if guidance == AROUND_OBSTACLES and guidance not in kept and not obstacles:
            raise PlanError("guidance=obstacle: expected obstacles to guide around, found none")
        sample = self.model.config.sample
        lambda_r = sample.robot_weight if robot_weight is None else _number("robot_weight", robot_weight)
        lambda_o = sample.obstacle_weight if obstacle_weight is None else _number("obstacle_weight", obstacle_weight)
        weighted = []
        if guidance in (ALL, *kept):
            weighted.append((self.model.u_c, lambda_r))
        if guidance in (ALL, AROUND_OBSTACLES) and obstacles:
            # Guided as in training, with its margin; judged without.
            near = Sum([self._avoidance(disc, self.model.config.correction.margin) for disc in obstacles])
            weighted.append((Correction(near, self.model.u_c.smoothing), lambda_o))

        def arrive(x_0: Tensor, ends: Tensor) -> Tensor:
            v = self.model.field(NONE, ends)
            v = self.model.guided(v, *weighted) if weighted else v
            return integrate(v, x_0, sample.steps, sample.solver)

        return arrive

    def _avoidance(self, disc: Obstacle, margin: float = 0.0) -> Constraint:
        """A disc as a constraint with the run's barrier."""
        try:
            return self.model.task.avoidance([disc]).shaped(barrier(self.model.config), margin)
        except ValueError as error:
            raise PlanError(str(error)) from None

    def _candidates(self, arrive: Flow, y: Tensor, index: Sequence[int], num: int, seed: int) -> Tensor:
        """`num` trajectories for each row of y (B, O, D), which they meet at the waypoints `index`: (B, num, T, D).

        `arrive` takes samples x_0 of the source to x_1, for their starts and goals.
        """
        try:
            source = self.model.source.condition(index)
        except ValueError as error:
            raise PlanError(f"via: {error}") from None
        # Each pair's own draws, so that they do not depend on the other pairs.
        drawn = [self._drawn(source, pair.expand(num, -1, -1), random_stream("plan", seed)) for pair in y]
        y = y.repeat_interleave(num, dim=0)
        return exact(source, in_pieces(arrive, torch.cat(drawn), start_and_goal(y)), y).unflatten(0, (-1, num))

    def _drawn(self, source: Source, y: Tensor, noise: torch.Generator) -> Tensor:
        """x_0, (num, T, D), for rows of y (num, O, D) at the waypoints at which the source is conditioned."""
        return source.sample(y, noise)


class DescentPlanner(Planner):
    """Plans without a model: candidates are demonstrations drawn anew, and descent alone makes them feasible.

        plans = DescentPlanner.of("weave").best_of(start, goal)

    In crowds and with arms a candidate is made of each robot's own way; in other tasks it is a sample of the source
    that is most likely for the demonstrations. Nothing is trained, so nothing of the task is learned but that.
    """

    @classmethod
    def of(cls, task: Task | str, **settings: Any) -> "DescentPlanner":
        """The planner of a task.

        Args:
            task: its name, or a task, such as one of one's own or one in the map of a scene.
            settings: of `config.load`, with two underscores in place of a dot, such as `correction__margin=0.05`.

        Raises:
            ConfigError: there is no such task, it lacks something, or a setting cannot be used.
            DemonstrationError: its demonstrations cannot be used.
        """
        name = task if isinstance(task, str) else task.name if task.name in TASKS else config.PAPERS_TASK
        given = ["ablation=plus", f"sample.descent={REPAIR_STEPS}", *config.arguments_of(settings)]
        chosen = config.load([f"task={name}", *given])
        if chosen.data.path is not None:
            expected = "expected none, without a model the task's own demonstrations are planned from"
            raise ConfigError(f"data.path={brief(chosen.data.path)}: {expected}")
        made = build_task(chosen) if isinstance(task, str) else of_object(task, chosen)
        if not isinstance(made, SceneTask):
            found = demonstrated(made, FITTED_TO, chosen.data.seed)
            made = told(made, found.scale, found.offset, found.seconds)
            chosen = fitted(chosen, found.x)
        return cls(ConFlow(chosen, made))

    def _drawn(self, source: Source, y: Tensor, noise: torch.Generator) -> Tensor:
        task = self.model.task
        return task.between(y[:, [0, -1]], noise) if isinstance(task, SceneTask) else source.sample(y, noise)

    def _flow(
        self,
        guidance: str | None,
        obstacles: Sequence[Obstacle],
        robot_weight: float | None,
        obstacle_weight: float | None,
    ) -> Flow:
        for name, weight in {"robot_weight": robot_weight, "obstacle_weight": obstacle_weight}.items():
            if weight is not None:
                raise PlanError(f"{name}={brief(weight)}: expected none, without a model there is no flow to guide")
        if guidance not in (ALL, NONE, None):
            raise PlanError(
                f"guidance={brief(guidance)}: expected all or none, without a model there is no flow to guide"
            )
        return lambda x_0, ends: x_0


def looks(propose: Callable[[int], Tensor], u_c: Correction) -> Iterator[Tensor]:
    """Candidates (num, T, D) on their way down u^c, for ever: those proposed for 0, 1, ..., ROUNDS looks of each."""
    for draw in count():
        yield from islice(descent(propose(draw), u_c, MOMENTUM), 0, CHECKED * ROUNDS, CHECKED)


def _nearest(plans: Plans) -> Plans:
    """The one of a pair's plans that is best, or, where none is feasible, nearest to it."""
    best = 0 if bool(plans.feasible[0]) else int(plans.clearance.argmax())
    return plans[best : best + 1]


def _better(one: Plans, other: Plans) -> Plans:
    """Of two single plans the feasible one, or the one nearer to it; the first of equals."""
    return max(one, other, key=lambda plan: (bool(plan.feasible), float(plan.clearance)))


def exact(source: Source, x: Tensor, y: Tensor) -> Tensor:
    """x + W (y - x_O), and y to the last bit at the waypoints O: x and the result (batch, T, D), y (batch, O, D).

    The flow leaves y by about 1e-3. Closing the gap at O alone would be a kink; W, the source's conditional mean,
    spreads it as smoothly as the source's samples are, and where there is no gap it changes nothing.
    """
    x = x + source.mean(y - source.observe(x))
    x[:, source.index] = y
    return x


def _ranked(x: Tensor, constraint: Constraint) -> Plans:
    """Trajectories x (B, num, T, D) judged and sorted."""
    flat, pairs = x.flatten(0, 1), x.shape[:2]
    clearance = constraint.closest(flat).view(pairs)
    feasible = (clearance >= 0) & ~leaves_workspace(flat).view(pairs)
    smooth = smoothness(constraint.robots, flat).view(pairs)
    order = smooth.argsort(dim=1, stable=True)
    order = order.gather(1, feasible.gather(1, order).argsort(dim=1, descending=True, stable=True))
    return Plans(
        x.take_along_dim(order[..., None, None], dim=1),
        *(values.gather(1, order) for values in (clearance, feasible, smooth)),
    )


def _checkpoint(run: str | Path) -> Path:
    """Where the checkpoint of a run is; a text is a path if it ends in .ckpt or there is such a file."""
    if not isinstance(run, str | Path):
        raise PlanError(f"run={brief(run)}: expected latest, an id, NAME, PRESET/NAME, or the path of a {MODEL_FILE}")
    if isinstance(run, Path) or run.endswith(".ckpt"):
        return Path(run)
    try:
        if Path(run).is_file():
            return Path(run)
    except OSError:  # too long a name, for instance
        pass
    return _of_store(run)


def _of_store(run: str) -> Path:
    """The checkpoint of a run in the store. What that needs is imported here: a program with a file does without."""
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    from conflow.tracking.store import artifact, find_run

    try:
        return artifact(find_run(run), MODEL_FILE)
    except ConfigError as error:
        raise PlanError(str(error)) from None
    except (MlflowException, SQLAlchemyError, OSError, ModuleNotFoundError) as error:  # of a database's driver
        raise PlanError(
            f"run={run}: expected a run in the store with a {MODEL_FILE}, which cannot be had: {brief(error)}"
        ) from None


def _numbers(name: str, value: Numbers, expected: str) -> Tensor:
    """Real numbers in float64."""
    try:
        numbers = value.detach().cpu() if isinstance(value, Tensor) else torch.from_numpy(np.array(value))
    except (TypeError, ValueError, RuntimeError):
        raise PlanError(f"{name}={brief(value)}: expected {expected}") from None
    if numbers.dtype == torch.bool or numbers.is_complex():
        raise PlanError(f"{name}={brief(value)}: found {numbers.dtype}, expected {expected}")
    return numbers.double()


def _refuse(name: str, y: Tensor, refused: Tensor, reason: str) -> None:
    """Refuse positions y (D,) or (B, D) of which `refused`, boolean () or (B,), names some: the first is shown."""
    if bool(refused.any()):
        row = int(refused.view(-1).nonzero()[0])
        place = f"{name}[{row}]" if y.ndim == 2 else name
        raise PlanError(f"{place}={_text(y.view(-1, y.shape[-1])[row].tolist())}: {reason}")


def _who(constraint: Constraint, x: Tensor, waypoint: int) -> str:
    """Which robots of a trajectory (1, T, D) come so close at a waypoint; nothing where that cannot be said."""
    robots, (c, pullback) = constraint.robots, constraint.vjp(x)
    smallest = torch.zeros_like(c)
    smallest[0, waypoint, c[0, waypoint].argmin()] = 1
    moved = robots.moved(pullback(smallest))[0, waypoint]
    named = sorted({int(robot) + 1 for robot in robots.owner[moved]})
    if robots.count == 1 or len(named) not in (1, 2):
        return ""
    return f" at robot {named[0]}" if len(named) == 1 else f" between robots {named[0]} and {named[1]}"


def _via_points(via: Sequence[ViaPoint], T: int) -> dict[int, Numbers]:
    """Waypoints and the configurations that are given for them."""
    points: dict[int, Numbers] = {}
    for i, point in enumerate(_items("via", via)):
        try:
            s, position = point
        except (TypeError, ValueError):
            raise PlanError(f"via[{i}]={brief(point)}: expected (s, position)") from None
        if not _is_real(s) or not 0 < s < 1:
            raise PlanError(f"via[{i}]: s={brief(s)}, expected a number above 0 and below 1")
        waypoint = min(max(round(s * (T - 1)), 1), T - 2)
        if waypoint in points:
            raise PlanError(
                f"via[{i}]: s={s} falls on waypoint {waypoint} of {T} as via[{list(points).index(waypoint)}] does, "
                "expected one via-point per waypoint"
            )
        points[waypoint] = position
    return points


def _obstacle(name: str, value: Obstacle | Sequence[float]) -> Obstacle:
    expected = "an Obstacle or (x, y, radius), in space a Ball or (x, y, z, radius)"
    if isinstance(value, Obstacle):
        value = (value.x, value.y, *([value.z] if isinstance(value, Ball) else []), value.radius)
    numbers = _numbers(name, value, expected).float()  # as it is computed with
    if numbers.shape not in ((3,), (4,)):
        raise PlanError(f"{name}={brief(value)}: found shape {tuple(numbers.shape)}, expected {expected}")
    if not bool(numbers.isfinite().all()) or not numbers[-1] > 0:
        raise PlanError(f"{name}={_text(numbers.tolist())}: expected finite numbers and a radius above 0")
    x, y, *z, radius = (float(number) for number in value)
    return Ball(x, y, radius, *z) if z else Obstacle(x, y, radius)


def _items(name: str, value: Iterable[Any]) -> list[Any]:
    try:
        return list(value)
    except TypeError:
        raise PlanError(f"{name}={brief(value)}: expected a sequence") from None


def _whole(name: str, value: Any, low: int) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < low:
        raise PlanError(f"{name}={brief(value)}: expected a whole number of at least {low}")
    return int(value)


def _number(name: str, value: Any) -> float:
    allowed = Range(0, 1e9)
    if not _is_real(value) or value not in allowed:
        raise PlanError(f"{name}={brief(value)}: expected a finite number {allowed}")
    return float(value)


def _is_real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _text(numbers: Iterable[float]) -> str:
    return f"({', '.join(f'{number:.6g}' for number in numbers)})"
