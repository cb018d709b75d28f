"""`make sample`: plan for one pair of start and goal, write the plans, and draw them."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from conflow import commandline
from conflow.figures.plans import picture
from conflow.planner import DescentPlanner, PlanError, Planner, Plans
from conflow.scene.task import Task
from conflow.training.config import PAPERS_TASK
from conflow.training.metrics import wilson

WITHOUT = "none"
"""In place of a run: a plan without a model."""


def sample(
    options: Mapping[str, str], obstacles: Sequence[str] = (), via: Sequence[str] = (), task: Task | None = None
) -> str:
    """Plan for one pair as the command line asks, write the plans and their picture, and say what came of it.

    Args:
        options: run, start, goal, out, num, guidance and seed; task, where run is `none`.
        obstacles: each as "x,y,radius".
        via: each as "s,x1,y1,...", a waypoint to pass at the share s of the way.
        task: one's own, where it is of that.

    Raises:
        ConfigError: an option that cannot be used, or as `Planner.load` and `Planner.plan`; a file exists already.
    """
    out = _new_files(options["out"])
    start, goal = (_parsed(key, options[key]) for key in ("start", "goal"))
    discs = [_parsed("obstacle", text) for text in obstacles]
    points = [(s, point) for s, *point in (_parsed("via", text) for text in via)]
    num, seed = commandline.whole(options, "num", 1, 10**6), commandline.whole(options, "seed", 0, 2**32 - 1)
    without = options["run"] == WITHOUT
    planner = (
        DescentPlanner.of(task or options["task"] or PAPERS_TASK) if without else Planner.load(options["run"], task)
    )
    plans = planner.plan(start, goal, num, discs, points, options["guidance"], seed)
    _save(out, planner, plans, start, goal, discs)
    feasible = int(plans.feasible.sum())
    low, high = wilson(feasible, num)
    taken = planner.model.config
    origin = f"Task {planner.model.task.name}, without a model" if without else f"Run {taken.preset}/{taken.name}"
    return (
        f"{origin}: {feasible} of {num} plans are feasible, {feasible / num:.1%} (95 % interval "
        f"{low:.1%} to {high:.1%}); best clearance {float(plans.clearance.max()):.3f}\n"
        f"Written: {out} and {out.with_suffix('.png')}"
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
    path: Path,
    planner: Planner,
    plans: Plans,
    start: Sequence[float],
    goal: Sequence[float],
    obstacles: Sequence[Sequence[float]],
) -> None:
    arrays = {field.name: getattr(plans, field.name).numpy() for field in fields(plans)}
    written: list[Path] = []
    try:
        with tempfile.TemporaryDirectory(prefix=".conflow-", dir=path.parent) as folder:
            files = (path, path.with_suffix(".png"))
            plain, drawn = (Path(folder, file.name) for file in files)
            np.savez(plain, **arrays, start=np.array(start, np.float32), goal=np.array(goal, np.float32))
            picture(planner, plans, obstacles).savefig(drawn, format="png", dpi=110)
            for file, part in zip(files, (plain, drawn), strict=True):
                file.hardlink_to(part)  # which refuses to replace a file that has appeared in the meantime
                written.append(file)
    except OSError as error:
        for file in written:
            file.unlink()
        raise _unwritable(path, error) from None


def _unwritable(path: Path, error: OSError) -> PlanError:
    return PlanError(f"out={path}: {error.strerror}, expected a new file that can be written")
