"""Trajectories in the workspace, in colours that colour-blind readers can tell apart."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from torch import Tensor

from conflow.flow.sampler import states
from conflow.scene.constraint import Constraint
from conflow.training.build import judged_radius, robot_avoidance
from conflow.training.config import SPLITS, SplitName
from conflow.training.datamodule import DemonstrationData
from conflow.training.evaluation import Evaluation
from conflow.training.module import SETTINGS, ConFlow

# Okabe and Ito's palette.
ROBOTS = ("#0072B2", "#009E73", "#CC79A7", "#56B4E9")
COLLISION = "#D55E00"
OBSTACLE = "#999999"
OF_TRAINING = ("page", "demonstrations", "sources")
"""The pictures that training draws and logs."""
SHOWN = 60
DPI = 110
TITLES = {"none": "generated, no guidance", "robot": "guided around robots", "obstacle": "guided around obstacle"}
TIMES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def demonstrations(data: DemonstrationData) -> Figure:
    """The paper's first figure: demonstrations without and with a collision."""
    figure, axes = _workspaces(1, 2)
    robots = robot_avoidance(data.config, data.D)
    for axis, violates, name in zip(axes, (False, True), ("feasible, $D^+$", "in collision, $D^-$"), strict=True):
        chosen = data.violates == violates
        _trajectories(axis, data.x[chosen], data.violates[chosen], robots)
        axis.set_title(f"{name}: {int(chosen.sum())} of {len(data.x)}")
    _legend(figure, data.D // 2)
    return figure


def sources(model: ConFlow, evaluation: Evaluation) -> Figure:
    """The paper's second figure: samples of the source beside what the flow makes of them."""
    figure, axes = _workspaces(1, 2)
    panels = {"source, $x_0$": evaluation.source_samples, "generated, $x_1$": evaluation.samples["none"]}
    for axis, (name, x) in zip(axes, panels.items(), strict=True):
        _judged(axis, x, model.robots, name)
    _zoom_out(axes[:1], evaluation.source_samples)
    _legend(figure, model.D // 2)
    return figure


def page(model: ConFlow, data: DemonstrationData, evaluation: Evaluation, split: SplitName) -> Figure:
    """A run at a glance: demonstrations of a split, what it starts from, and what it makes under the three settings."""
    config = model.config
    figure, axes = _workspaces(2, 3)
    _judged(axes[0], data.held_out[split].x, model.robots, f"{SPLITS[split]} demonstrations")
    _judged(axes[1], evaluation.source_samples, model.robots, f"source: {config.source.kind}")
    _zoom_out(axes[1:2], evaluation.source_samples)
    _settings(axes[2:5], model, evaluation)
    _distances(axes[5], evaluation.samples["none"], model)
    axes[5].set_title("distance of the robots\nno guidance")
    _legend(figure, model.D // 2)
    figure.suptitle(f"{config.ablation}, seed {config.seed}, preset {config.preset}, {SPLITS[split]} split")
    return figure


def methods(runs: Sequence[tuple[str, ConFlow, Evaluation]]) -> Figure:
    """Several runs, a row for each, under the three settings."""
    figure, axes = _workspaces(len(runs), len(SETTINGS))
    for i, (name, model, evaluation) in enumerate(runs):
        row = axes[len(SETTINGS) * i :]
        _settings(row[: len(SETTINGS)], model, evaluation)
        row[0].set_ylabel(f"{name}\n\n{row[0].get_ylabel()}")
    _legend(figure, max(model.D // 2 for _, model, _ in runs))
    return figure


def flow(model: ConFlow, x_0: Tensor, ends: Tensor | None = None) -> Figure:
    """The ODE without guidance from samples x_0 (batch, T, D) of the source to trajectories, at six times t."""
    steps, solver = model.config.sample.steps, model.config.sample.solver
    figure, axes = _workspaces(2, 3)
    shown = [round(t * steps) for t in TIMES]
    x = {k: x for k, x in enumerate(states(model.field("none", ends), x_0, steps, solver)) if k in shown}
    for axis, k in zip(axes, shown, strict=True):
        _judged(axis, x[k], model.robots, f"$t = {k / steps:.2g}$")
    _zoom_out(axes, x_0)
    _legend(figure, model.D // 2)
    return figure


def distances(model: ConFlow, evaluation: Evaluation) -> Figure:
    """The distance of the nearest robots along s under the three settings, with the distance at which they touch."""
    figure = Figure(figsize=(10.8, 3.9), layout="constrained")
    for axis, setting in zip(figure.subplots(1, len(SETTINGS), sharey=True), SETTINGS, strict=True):
        x = evaluation.samples[setting]
        _distances(axis, x, model)
        axis.set_title(f"{TITLES[setting]}\n{_share(model.robots.violation(x))} collide")
        axis.label_outer()
    handles = [
        Line2D([], [], color="#666666", label="without collision"),
        Line2D([], [], color=COLLISION, label=f"in collision (first {SHOWN} drawn)"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    return figure


def of_training(model: ConFlow, data: DemonstrationData, evaluation: Evaluation, folder: Path) -> None:
    """Write the pictures that a run gets at its end, of its samples of the validation split, into a folder."""
    save(
        {
            "page": page(model, data, evaluation, "val"),
            "demonstrations": demonstrations(data),
            "sources": sources(model, evaluation),
        },
        folder,
    )


def save(figures: Mapping[str, Figure], folder: Path) -> None:
    """Write each figure as <folder>/<name>.png."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=DPI)


def _workspaces(rows: int, columns: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(3.6 * columns, 3.9 * rows + 0.5), layout="constrained")
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(rows * columns)]
    for i, axis in enumerate(axes):
        axis.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal")
        axis.set_xlabel("x (workspace units)" if i >= (rows - 1) * columns else "")
        axis.set_ylabel("y (workspace units)" if i % columns == 0 else "")
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _zoom_out(axes: Sequence[Axes], x: Tensor) -> None:
    """Show all but the farthest of the trajectories x (batch, T, D), and the workspace as a square among them."""
    reach = max(1.05, float(x[:SHOWN].abs().quantile(0.995)))
    for axis in axes:
        axis.set(xlim=(-reach, reach), ylim=(-reach, reach))
        axis.add_patch(Rectangle((-1, -1), 2, 2, fill=False, ls=":", color="black", lw=0.8, zorder=3))


def _settings(axes: Sequence[Axes], model: ConFlow, evaluation: Evaluation) -> None:
    """Each setting's trajectories, judged by what the setting avoids."""
    for axis, setting in zip(axes, SETTINGS, strict=True):
        if setting != "obstacle":
            _judged(axis, evaluation.samples[setting], model.robots, TITLES[setting])
            continue
        _judged(axis, evaluation.samples[setting], model.obstacle, TITLES[setting], "hit it")
        _obstacle(axis, model)
        unguided = _share(model.obstacle.violation(evaluation.samples["none"]))
        axis.set_xlabel(f"hits unguided: {unguided}\n{axis.get_xlabel()}".strip())


def _judged(axis: Axes, x: Tensor, constraint: Constraint, name: str, verb: str = "collide") -> None:
    """Trajectories under a title that says how many of all of them violate the constraint."""
    violates = constraint.violation(x)
    _trajectories(axis, x, violates, constraint)
    axis.set_title(f"{name}\n{_share(violates)} {verb}")


def _share(violates: Tensor) -> str:
    return f"{int(violates.sum())} of {len(violates)} ({violates.float().mean():.1%})"


def _trajectories(axis: Axes, x: Tensor, violates: Tensor, constraint: Constraint) -> None:
    """The first trajectories, each robot's in its colour; those in violation on top, marked at the closest approach."""
    x, violates = x[:SHOWN], violates[:SHOWN]
    paths = x.unflatten(2, (-1, 2))
    for robot in range(paths.shape[2]):
        colour = ROBOTS[robot % len(ROBOTS)]
        axis.add_collection(LineCollection(list(paths[~violates, :, robot].numpy()), colors=colour, alpha=0.4, lw=0.9))
        axis.add_collection(
            LineCollection(list(paths[violates, :, robot].numpy()), colors=COLLISION, alpha=0.9, lw=0.9)
        )
        starts = paths[:, 0, robot]
        axis.scatter(starts[:, 0], starts[:, 1], s=6, color=colour, zorder=3)
    contacts = _contacts(x, constraint)[violates]
    axis.scatter(contacts[:, 0], contacts[:, 1], marker="x", s=22, color="black", linewidth=0.9, zorder=4)


def _contacts(x: Tensor, constraint: Constraint) -> Tensor:
    """Where trajectories (batch, T, D) are closest to a collision, (batch, 2): amid the robots that C pushes there."""
    closest = torch.arange(len(x)), constraint.clearance(x).argmin(dim=1)
    pushed = constraint.gradient(x).unflatten(2, (-1, 2))[closest].norm(dim=2, keepdim=True) > 0
    return (x.unflatten(2, (-1, 2))[closest] * pushed).sum(dim=1) / pushed.sum(dim=1)


def _distances(axis: Axes, x: Tensor, model: ConFlow) -> None:
    x, radius = x[:SHOWN], judged_radius(model.config)
    distance, violates = model.robots.clearance(x) + radius, model.robots.violation(x)
    s = torch.linspace(0, 1, x.shape[1])
    for shown, colour in ((~violates, "#666666"), (violates, COLLISION)):
        axis.plot(s, distance[shown].T, color=colour, alpha=0.5, lw=0.9)
    axis.axhline(radius, color="black", ls="--", lw=1)
    axis.annotate(f"touching at {radius:g}", (0.02, radius), textcoords="offset points", xytext=(0, 3))
    axis.set(xlim=(0, 1), ylim=(0, 2.1), aspect="auto")
    axis.set(xlabel="s (trajectory time)", ylabel="distance (workspace units)")
    axis.set_box_aspect(1)
    axis.spines[["top", "right"]].set_visible(False)


def _obstacle(axis: Axes, model: ConFlow) -> None:
    """The obstacle, and around it the circle that the robots' centres must not enter."""
    obstacle = model.config.sample.obstacle
    touching = obstacle.radius + model.config.constraint.radius / 2
    axis.add_patch(Circle((obstacle.x, obstacle.y), obstacle.radius, color=OBSTACLE, zorder=2.5))
    axis.add_patch(Circle((obstacle.x, obstacle.y), touching, fill=False, ls="--", color="black", lw=1, zorder=3))


def _legend(figure: Figure, robots: int) -> None:
    handles = [Line2D([], [], color=ROBOTS[i % len(ROBOTS)], label=f"robot {i + 1}") for i in range(robots)]
    handles.append(
        Line2D(
            [],
            [],
            color=COLLISION,
            marker="x",
            markeredgecolor="black",
            label=f"in collision, crossed where closest (first {SHOWN} drawn)",
        )
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
