"""Pictures of demonstrations and samples, in colours that colour-blind readers can tell apart."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from torch import Tensor

from conflow.experiment.callbacks import Evaluate
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.module import ConFlow
from conflow.scene.constraint import Constraint, Obstacle

matplotlib.use("Agg")

# Okabe and Ito's palette.
ROBOTS = ("#0072B2", "#009E73", "#CC79A7", "#56B4E9")
COLLISION = "#D55E00"
SHOWN = 60
TITLES = {"none": "generated, no guidance", "robot": "guided around robots", "obstacle": "guided around obstacle"}


def demonstrations(data: DemonstrationData) -> Figure:
    """The paper's first figure: demonstrations without and with a collision."""
    figure, axes = _workspaces(1, 2)
    for axis, violates, name in zip(axes, (False, True), ("feasible, D+", "in collision, D-"), strict=True):
        x = data.x[data.violates == violates]
        _trajectories(axis, x, data.violates[data.violates == violates])
        axis.set_title(f"{name}: {len(x)} of {len(data.x)}")
    _legend(figure)
    return figure


def sources(model: ConFlow, evaluate: Evaluate) -> Figure:
    """The paper's second figure: samples of the source beside what the flow makes of them."""
    figure, axes = _workspaces(1, 2)
    panels = {"source, $x_0$": evaluate.source_samples, "generated, $x_1$": evaluate.samples["none"]}
    for axis, (name, x) in zip(axes, panels.items(), strict=True):
        _judged(axis, x, model.robots, name)
    _legend(figure)
    return figure


def page(model: ConFlow, data: DemonstrationData, evaluate: Evaluate) -> Figure:
    """A run at a glance: what it learned from, what it starts from, and what it makes under the three settings."""
    config = model.config
    figure, axes = _workspaces(2, 3)
    panels = {"test demonstrations": data.test.x, f"source: {config.source.kind}": evaluate.source_samples}
    panels |= {TITLES[setting]: x for setting, x in evaluate.samples.items()}
    for axis, (name, x) in zip(axes, panels.items(), strict=False):
        _judged(axis, x, model.robots, name)
    guided = axes[list(panels).index(TITLES["obstacle"])]
    _obstacle(guided, config.sample.obstacle)
    rate, unguided = (evaluate.results[setting]["object_collision_rate"] for setting in ("obstacle", "none"))
    guided.set_xlabel(f"obstacle hit by {rate:.1%}, unguided {unguided:.1%}")
    _distances(axes[-1], evaluate.samples["none"], model.robots, config.constraint.radius)
    _legend(figure)
    figure.suptitle(f"{config.ablation}, seed {config.seed}, preset {config.preset}")
    return figure


def save(figures: Mapping[str, Figure], folder: Path) -> None:
    """Write each figure as <folder>/<name>.png."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=110)


def _workspaces(rows: int, columns: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(3.6 * columns, 3.9 * rows + 0.5), layout="constrained")
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(rows * columns)]
    for i, axis in enumerate(axes):
        axis.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal")
        axis.set_xlabel("x" if i >= (rows - 1) * columns else "")
        axis.set_ylabel("y (workspace units)" if i % columns == 0 else "")
        axis.tick_params(labelleft=i % columns == 0)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _judged(axis: Axes, x: Tensor, robots: Constraint, name: str) -> None:
    """Trajectories under a title that says how many of all of them collide."""
    violates = robots.violation(x)
    _trajectories(axis, x, violates)
    axis.set_title(f"{name}\n{int(violates.sum())} of {len(x)} collide ({violates.float().mean():.1%})")


def _trajectories(axis: Axes, x: Tensor, violates: Tensor) -> None:
    """The first trajectories, each robot's in its colour; those in collision on top, marked at the closest approach."""
    x, violates = x[:SHOWN], violates[:SHOWN]
    paths = x.reshape(*x.shape[:2], -1, 2)
    for robot in range(paths.shape[2]):
        colour = ROBOTS[robot % len(ROBOTS)]
        axis.add_collection(LineCollection(list(paths[~violates, :, robot].numpy()), colors=colour, alpha=0.4, lw=0.9))
        axis.add_collection(
            LineCollection(list(paths[violates, :, robot].numpy()), colors=COLLISION, alpha=0.9, lw=0.9)
        )
        starts = paths[:, 0, robot]
        axis.scatter(starts[:, 0], starts[:, 1], s=6, color=colour, zorder=3)
    closest = (paths[:, :, 0] - paths[:, :, 1]).norm(dim=2).argmin(dim=1)
    middle = paths[torch.arange(len(x)), closest].mean(dim=1)[violates]
    axis.scatter(middle[:, 0], middle[:, 1], marker="x", s=22, color="black", linewidth=0.9, zorder=4)


def _distances(axis: Axes, x: Tensor, robots: Constraint, radius: float) -> None:
    """The distance of the nearest robots along s, with the distance at which they touch."""
    distance = (robots.clearance(x) + radius)[:SHOWN]
    s = np.linspace(0, 1, x.shape[1])
    collides = distance.amin(dim=1) < radius
    for shown, colour in ((~collides, "#666666"), (collides, COLLISION)):
        axis.plot(s, distance[shown].T.numpy(), color=colour, alpha=0.5, lw=0.9)
    axis.axhline(radius, color="black", ls="--", lw=1)
    axis.annotate(f"touching at {radius:g}", (0.02, radius), textcoords="offset points", xytext=(0, 3))
    axis.set(xlim=(0, 1), ylim=(0, 2.1), aspect="auto", xlabel="s", title="distance of the robots\nno guidance")
    axis.set_box_aspect(1)
    axis.tick_params(labelleft=True)


def _obstacle(axis: Axes, obstacle: Obstacle) -> None:
    axis.add_patch(Circle((obstacle.x, obstacle.y), obstacle.radius, color="#999999", zorder=2))


def _legend(figure: Figure) -> None:
    handles = [Line2D([], [], color=ROBOTS[i], label=f"robot {i + 1}") for i in range(2)]
    handles.append(Line2D([], [], color=COLLISION, marker="x", markeredgecolor="black", label="in collision"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
