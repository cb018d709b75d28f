"""The public face for other programs: load a run, plan trajectories between starts and goals.

>>> plans = Planner.load("latest").plan(start=(-0.8, 0, 0.8, 0), goal=(0.8, 0, -0.8, 0))
>>> best, clearance = plans.x[0], plans.clearance[0]
"""

import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from mlflow.exceptions import MlflowException
from numpy.typing import ArrayLike
from sqlalchemy.exc import SQLAlchemyError
from torch import Tensor

from conflow import commandline
from conflow.errors import ConfigError, brief, nearest
from conflow.figures.workspace import COLLISION, OBSTACLE, ROBOTS
from conflow.flow.correction import Correction
from conflow.flow.sampler import Field, in_pieces, integrate
from conflow.flow.source import Source
from conflow.scene.constraint import Constraint, Obstacle, Sum
from conflow.tracking.store import artifact, find_run
from conflow.training.build import obstacle_avoidance, random_stream
from conflow.training.config import Range
from conflow.training.memory import check_memory
from conflow.training.metrics import leaves_workspace, smoothness, wilson
from conflow.training.module import ConFlow, start_and_goal
from conflow.training.reload import MODEL_FILE, load_model

Guidance = Literal["none", "robot", "obstacle", "both"]
Numbers = ArrayLike | Tensor
ViaPoint = tuple[float, Numbers]


class PlanError(ConfigError):
    """A run, a request or a file that cannot be used: what was given and what was expected, in one line."""


@dataclass(frozen=True, eq=False)
class Plans:
    """Trajectories and how good they are: feasible ones first, each group from the smoothest on.

    Attributes:
        x: (B, num, T, D) in workspace units, or (num, T, D) for a single pair; likewise below.
        clearance: the smallest on the way, straight from waypoint to waypoint, over robots and the obstacles given,
            (B, num).
        feasible: there is no collision on the way, and all of it is inside the workspace; boolean (B, num).
        smoothness: mean norm of the second difference of the robots' positions, (B, num); smaller is smoother.
    """

    x: Tensor
    clearance: Tensor
    feasible: Tensor
    smoothness: Tensor

    def __getitem__(self, pair: int) -> "Plans":
        """The plans of one pair."""
        return Plans(*(getattr(self, field.name)[pair] for field in fields(self)))


class Planner:
    """Plans with a trained model.

    Args:
        model: on the CPU.
    """

    def __init__(self, model: ConFlow) -> None:
        self.model = model.eval()

    @classmethod
    def load(cls, run: str | Path = "latest") -> "Planner":
        """The planner of a run: "latest", its id, NAME, PRESET/NAME, or the path of a `model.ckpt`, without a store.

        Only weights and plain values are read; no code in the file is executed.

        Raises:
            PlanError: there is no such run or file, the store cannot be used, or the file is damaged or no run's
                `model.ckpt`.
        """
        path = _checkpoint(run)
        try:
            # Of a foreign file torch says a word of warning before it refuses it.
            with warnings.catch_warnings(action="ignore"):
                return cls(load_model(path))
        except FileNotFoundError:
            raise PlanError(f"run={run}: no such file, expected the {MODEL_FILE} of a run") from None
        except Exception:  # a foreign or damaged file fails in any of a dozen ways, from EOFError to KeyError
            raise PlanError(
                f"run={run}: expected the {MODEL_FILE} of a run of this version, found a damaged or foreign file"
            ) from None

    def plan(
        self,
        start: Numbers,
        goal: Numbers,
        num: int = 64,
        obstacles: Sequence[Obstacle | Sequence[float]] = (),
        via: Sequence[ViaPoint] = (),
        guidance: Guidance | None = "both",
        seed: int = 0,
        *,
        robot_weight: float | None = None,
        obstacle_weight: float | None = None,
    ) -> Plans:
        """`num` trajectories x_1 for every pair of start and goal.

        x_0 ~ p(. | y), the run's source conditioned on y = (start, via-points, goal); x_1 is where the guided flow
        v + lambda_r u^c_robots + lambda_o u^c_obstacles takes it. Then `exact` makes it meet y to the last bit, and
        clearance and smoothness are those of the result. The noise depends on the seed alone, so a pair gets the same
        plans alone and, to rounding, in any batch.

        What the model has not seen it cannot promise. Via-points, and starts and goals unlike the demonstrations', are
        met all the same, but the flow between them is a guess. One that was trained from an unconditioned source ends
        where demonstrations end, wherever the goal is: `exact` then bends the whole trajectory to reach it (`gp`), or,
        W being a unit map, moves that waypoint alone and leaves a jump (`gaussian`). The smoothness shows it.

        Args:
            start: positions as (x1, y1, x2, y2, ...), (D,) or (B, D), in workspace units, [-1, 1].
            goal: likewise, as many as starts.
            num: trajectories per pair.
            obstacles: discs to avoid, each an `Obstacle` or (x, y, radius).
            via: (s, position (D,)) for all pairs alike; s, between 0 and 1, is moved to the nearest inner waypoint.
            guidance: "robot": around each other, "obstacle": around the obstacles, "both": around each other and
                around obstacles where there are some, "none" or None: the flow alone.
            seed: of the noise.
            robot_weight: lambda_r, where guidance uses it; the run's `sample.robot_weight` unless given.
            obstacle_weight: lambda_o, likewise.

        Raises:
            PlanError: names the argument, its value and what was expected.
        """
        num, seed = _whole("num", num, low=1), _whole("seed", seed, low=0)
        start, goal = _positions("start", start, self.model.D), _positions("goal", goal, self.model.D)
        if goal.shape != start.shape:
            raise PlanError(f"goal: found shape {tuple(goal.shape)}, expected that of start, {tuple(start.shape)}")
        points = _via_points(via, self.model.T, self.model.D)
        discs = [_obstacle(f"obstacles[{i}]", disc) for i, disc in enumerate(_items("obstacles", obstacles))]
        constraint = Sum([self.model.robots, *map(self._avoidance, discs)])
        named = {"start": start, "goal": goal} | {f"via[{i}]": point for i, point in enumerate(points.values())}
        for name, position in named.items():
            _refuse_collision(name, position, constraint)

        y = torch.stack([start, *(point.expand_as(start) for point in points.values()), goal], dim=-2)
        y = y.reshape(-1, *y.shape[-2:])
        self._check_memory(num, len(y))
        sample = self.model.config.sample

        def arrive(x_0: Tensor, ends: Tensor) -> Tensor:
            v = self._field(ends, guidance, discs, robot_weight, obstacle_weight)
            return integrate(v, x_0, sample.steps, sample.solver)

        x = self._sample(arrive, y, (0, *points, -1), num, seed)
        plans = _ranked(x, constraint)
        return plans if start.ndim == 2 else plans[0]

    def _check_memory(self, num: int, pairs: int) -> None:
        """Refuse more plans than fit into memory: x_0, x_1, what is missing of y, and the result."""
        try:
            check_memory("num", num, 4 * 4 * num * pairs * self.model.T * self.model.D)
        except ConfigError as error:
            raise PlanError(str(error)) from None

    def _field(
        self,
        ends: Tensor,
        guidance: Guidance | None,
        obstacles: Sequence[Obstacle],
        robot_weight: float | None,
        obstacle_weight: float | None,
    ) -> Field:
        """The network's velocity field inside those of the guidance."""
        if guidance is not None and guidance not in get_args(Guidance):
            offer = nearest(str(guidance), get_args(Guidance))
            raise PlanError(f"guidance={brief(guidance)}: expected one of {', '.join(get_args(Guidance))}{offer}")
        if guidance == "obstacle" and not obstacles:
            raise PlanError("guidance=obstacle: expected obstacles to guide around, found none")
        sample = self.model.config.sample
        lambda_r = _weight("robot_weight", robot_weight, sample.robot_weight)
        lambda_o = _weight("obstacle_weight", obstacle_weight, sample.obstacle_weight)
        weighted = []
        if guidance in ("robot", "both"):
            weighted.append((self.model.u_c, lambda_r))
        if guidance in ("obstacle", "both") and obstacles:
            # Guided as in training, with its margin; judged without.
            near = Sum([self._avoidance(disc, self.model.config.correction.margin) for disc in obstacles])
            weighted.append((Correction(near, self.model.u_c.smoothing), lambda_o))
        v = self.model.field("none", ends)
        return self.model.guided(v, *weighted) if weighted else v

    def _avoidance(self, disc: Obstacle, margin: float = 0.0) -> Constraint:
        """The run's constraint, with its barrier, for another obstacle."""
        settings = self.model.config
        return obstacle_avoidance(
            replace(settings, sample=replace(settings.sample, obstacle=disc)), self.model.D, margin
        )

    def _sample(
        self, arrive: Callable[[Tensor, Tensor], Tensor], y: Tensor, index: Sequence[int], num: int, seed: int
    ) -> Tensor:
        """`num` trajectories for each row of y (B, O, D), which they meet at the waypoints `index`: (B, num, T, D).

        `arrive` takes samples x_0 of the source to x_1, for their starts and goals.
        """
        try:
            source = self.model.source.condition(index)
        except ValueError as error:
            raise PlanError(f"via: {error}") from None
        # Each pair's own draws, so that they do not depend on the other pairs.
        x_0 = torch.cat([source.sample(pair.expand(num, -1, -1), random_stream("plan", seed)) for pair in y])
        y = y.repeat_interleave(num, dim=0)
        return exact(source, in_pieces(arrive, x_0, start_and_goal(y)), y).unflatten(0, (-1, num))


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
    clearance = constraint.swept_clearance(flat).amin(dim=1).view(pairs)
    feasible = (clearance >= 0) & ~leaves_workspace(flat).view(pairs)
    smooth = smoothness(flat).view(pairs)
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
        return artifact(find_run(run), MODEL_FILE)
    except ConfigError as error:
        raise PlanError(str(error)) from None
    except (MlflowException, SQLAlchemyError, OSError, ModuleNotFoundError) as error:  # of a database's driver
        raise PlanError(
            f"run={run}: expected a run in the store with a {MODEL_FILE}, which cannot be had: {brief(error)}"
        ) from None


def _numbers(name: str, value: Numbers, expected: str) -> Tensor:
    """Real numbers in float32."""
    try:
        numbers = value.detach().cpu() if isinstance(value, Tensor) else torch.from_numpy(np.array(value))
    except (TypeError, ValueError, RuntimeError):
        raise PlanError(f"{name}={brief(value)}: expected {expected}") from None
    if numbers.dtype == torch.bool or numbers.is_complex():
        raise PlanError(f"{name}={brief(value)}: found {numbers.dtype}, expected {expected}")
    return numbers.float()


def _positions(name: str, value: Numbers, D: int, batch: bool = True) -> Tensor:
    """Positions (D,), with `batch` also (B, D), in the workspace."""
    expected = f"numbers of shape ({D},)" + f" or (B, {D})" * batch
    y = _numbers(name, value, expected)
    if y.ndim not in (1, 1 + batch) or y.shape[-1] != D or not len(y):
        raise PlanError(f"{name}={brief(value)}: found shape {tuple(y.shape)}, expected {expected}")
    # Not a number is not inside either.
    _refuse(name, y, ~(y.abs() <= 1).all(dim=-1), "expected finite numbers in the workspace [-1, 1]")
    return y


def _refuse(name: str, y: Tensor, refused: Tensor, reason: str) -> None:
    """Refuse positions y (D,) or (B, D) of which `refused`, boolean () or (B,), names some: the first is shown."""
    if bool(refused.any()):
        row = int(refused.view(-1).nonzero()[0])
        place = f"{name}[{row}]" if y.ndim == 2 else name
        raise PlanError(f"{place}={_text(y.view(-1, y.shape[-1])[row].tolist())}: {reason}")


def _refuse_collision(name: str, y: Tensor, constraint: Sum) -> None:
    """Refuse positions y (D,) or (B, D) in collision with robots or obstacles: no plan through them is feasible."""
    for i, term in enumerate(constraint.terms):
        what = f"obstacles[{i - 1}]" if i else "another robot"
        # As trajectories of one waypoint.
        clearance = term.clearance(y.view(-1, 1, y.shape[-1])).view(y.shape[:-1])
        _refuse(name, y, clearance < 0, f"in collision with {what}, expected a clearance of at least 0")


def _via_points(via: Sequence[ViaPoint], T: int, D: int) -> dict[int, Tensor]:
    """Waypoints and the positions (D,) there."""
    points: dict[int, Tensor] = {}
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
        points[waypoint] = _positions(f"via[{i}]", position, D, batch=False)
    return points


def _obstacle(name: str, value: Obstacle | Sequence[float]) -> Obstacle:
    expected = "an Obstacle or (x, y, radius)"
    triple = _numbers(name, astuple(value) if isinstance(value, Obstacle) else value, expected)
    if triple.shape != (3,):
        raise PlanError(f"{name}={brief(value)}: found shape {tuple(triple.shape)}, expected {expected}")
    if not bool(triple.isfinite().all()) or not triple[2] > 0:
        raise PlanError(f"{name}={_text(triple.tolist())}: expected finite numbers and a radius above 0")
    return value if isinstance(value, Obstacle) else Obstacle(*(float(number) for number in value))


def _items(name: str, value: Iterable[Any]) -> list[Any]:
    try:
        return list(value)
    except TypeError:
        raise PlanError(f"{name}={brief(value)}: expected a sequence") from None


def _whole(name: str, value: Any, low: int) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < low:
        raise PlanError(f"{name}={brief(value)}: expected a whole number of at least {low}")
    return int(value)


def _weight(name: str, value: Any, default: float) -> float:
    if value is None:
        return default
    allowed = Range(0, 1e9)
    if not _is_real(value) or value not in allowed:
        raise PlanError(f"{name}={brief(value)}: expected a finite number {allowed}")
    return float(value)


def _is_real(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _text(numbers: Iterable[float]) -> str:
    return f"({', '.join(f'{number:.6g}' for number in numbers)})"


def picture(plans: Plans, obstacles: Sequence[Obstacle] = ()) -> Figure:
    """The plans of one pair, each robot's in its colour, collisions on top in another, and the best plan in bold."""
    figure = Figure(figsize=(4.6, 5.0), layout="constrained")
    axis = figure.add_subplot(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal")
    axis.set(xlabel="x (workspace units)", ylabel="y (workspace units)")
    axis.spines[["top", "right"]].set_visible(False)
    axis.set_title(f"{int(plans.feasible.sum())} of {len(plans.x)} plans are feasible")
    paths = plans.x.unflatten(2, (-1, 2))
    for robot in range(paths.shape[2]):
        colour = ROBOTS[robot % len(ROBOTS)]
        for shown, drawn in ((plans.feasible, colour), (~plans.feasible, COLLISION)):
            axis.add_collection(LineCollection(list(paths[shown, :, robot].numpy()), colors=drawn, alpha=0.4, lw=0.9))
        axis.plot(*paths[0, :, robot].T, color=colour if plans.feasible[0] else COLLISION, lw=2.5)
        axis.plot(*paths[0, 0, robot], "o", color=colour, zorder=3, label=f"robot {robot + 1}")
        # A ring, so that in a swap it does not hide the other robot's start.
        axis.plot(*paths[0, -1, robot], "o", color=colour, zorder=3, ms=11, mfc="none", mew=2)
    axis.plot([], [], color=COLLISION, label="in collision")
    axis.plot([], [], "o", color="black", ms=11, mfc="none", mew=2, label="goal")
    for obstacle in obstacles:
        axis.add_patch(Circle((obstacle.x, obstacle.y), obstacle.radius, color=OBSTACLE, zorder=2.5))
    figure.legend(loc="outside lower center", ncols=paths.shape[2] + 2, frameon=False)
    return figure


def sample(options: Mapping[str, str], obstacles: Sequence[str] = ()) -> str:
    """Plan for one pair as the command line asks, write the plans and their picture, and say what came of it.

    Args:
        options: run, start, goal, out, num, guidance and seed.
        obstacles: each as "x,y,radius".

    Raises:
        ConfigError: an option that cannot be used, or as `Planner.load` and `Planner.plan`; a file exists already.
    """
    out = _new_files(options["out"])
    start, goal = (_parsed(key, options[key]) for key in ("start", "goal"))
    discs = [_parsed("obstacle", text) for text in obstacles]
    num, seed = commandline.whole(options, "num", 1, 10**6), commandline.whole(options, "seed", 0, 2**32 - 1)
    guidance = cast(Guidance, options["guidance"])
    plans = Planner.load(options["run"]).plan(start, goal, num, discs, guidance=guidance, seed=seed)
    _save(out, plans, start, goal, [Obstacle(*disc) for disc in discs])
    feasible = int(plans.feasible.sum())
    low, high = wilson(feasible, num)
    return (
        f"{feasible} of {num} plans are feasible, {feasible / num:.1%} (95 % interval {low:.1%} to {high:.1%}); "
        f"best clearance {float(plans.clearance.max()):.3f}\nWritten: {out} and {out.with_suffix('.png')}"
    )


def _parsed(key: str, text: str) -> list[float]:
    try:
        return [float(number) for number in text.split(",")]
    except ValueError:
        raise PlanError(f"{key}={text}: expected numbers with commas between, such as -0.8,0,0.8,0") from None


def _new_files(out: str) -> Path:
    """The path of the plans, if it and that of the picture can be written anew."""
    path = Path(out)
    if path.suffix != ".npz":
        raise PlanError(f"out={out}: expected a name that ends in .npz")
    try:
        if not path.parent.is_dir():
            raise PlanError(f"out={out}: expected an existing folder, found no {path.parent}")
        for file in (path, path.with_suffix(".png")):
            if file.exists():
                raise PlanError(f"out={out}: expected a new file, found that {file} exists already")
    except OSError as error:
        raise _unwritable(path, error) from None
    return path


def _save(
    path: Path, plans: Plans, start: Sequence[float], goal: Sequence[float], obstacles: Sequence[Obstacle]
) -> None:
    arrays = {field.name: getattr(plans, field.name).numpy() for field in fields(plans)}
    written: list[Path] = []
    try:
        with tempfile.TemporaryDirectory(prefix=".conflow-", dir=path.parent) as folder:
            files = (path, path.with_suffix(".png"))
            plain, drawn = (Path(folder, file.name) for file in files)
            np.savez(plain, **arrays, start=np.array(start, np.float32), goal=np.array(goal, np.float32))
            picture(plans, obstacles).savefig(drawn, format="png", dpi=110)
            for file, part in zip(files, (plain, drawn), strict=True):
                file.hardlink_to(part)  # which refuses to replace a file that has appeared in the meantime
                written.append(file)
    except OSError as error:
        for file in written:
            file.unlink()
        raise _unwritable(path, error) from None


def _unwritable(path: Path, error: OSError) -> PlanError:
    return PlanError(f"out={path}: {error.strerror}, expected a new file that can be written")
