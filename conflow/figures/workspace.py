"""Trajectories in the workspace, in colours that colour-blind readers can tell apart."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyBboxPatch, Rectangle
from torch import Tensor

from conflow.flow.sampler import states
from conflow.scene.constraint import Constraint, Sum
from conflow.scene.robots import Robots
from conflow.scene.settings import Box
from conflow.scene.task import Task
from conflow.training.build import NONE, REFINED, joined, labels
from conflow.training.config import SPLITS, SplitName
from conflow.training.datamodule import DemonstrationData
from conflow.training.evaluation import Evaluation
from conflow.training.model import ConFlow

# Okabe and Ito's palette.
ROBOTS = ("#0072B2", "#009E73", "#CC79A7", "#56B4E9")
COLLISION = "#D55E00"
OBSTACLE = "#999999"
OF_TRAINING = ("page", "demonstrations", "sources")
"""The pictures that training draws and logs."""
SHOWN = 60
NAMED = 6
"""Robots that a legend can name."""
DPI = 110
HAIR = 1e-5
TIMES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def titled(setting: str) -> str:
    """What a panel of a setting is called."""
    if setting == REFINED:
        return "guided, then descended"
    return "generated, no guidance" if setting == NONE else f"guided around {setting}"


def demonstrations(data: DemonstrationData) -> Figure:
    """The paper's first figure: demonstrations that keep the constraint, and those that violate it."""
    figure, axes = _workspaces(1, 2)
    kept = labels(data.config, data.task)
    for axis, violates, name in zip(axes, (False, True), ("feasible, $D^+$", "in violation, $D^-$"), strict=True):
        chosen = data.violates == violates
        _trajectories(axis, data.x[chosen], data.violates[chosen], kept)
        axis.set_title(f"{name}: {int(chosen.sum())} of {len(data.x)}")
    _standing(axes, data.task)
    _legend(figure, data.task.robots)
    return figure


def sources(model: ConFlow, evaluation: Evaluation) -> Figure:
    """The paper's second figure: samples of the source beside what the flow makes of them."""
    figure, axes = _workspaces(1, 2)
    panels = {"source, $x_0$": evaluation.source_samples, "generated, $x_1$": evaluation.samples["none"]}
    for axis, (name, x) in zip(axes, panels.items(), strict=True):
        _judged(axis, x, model.trained, name)
    _zoom_out(axes[:1], evaluation.source_samples)
    _standing(axes, model.task)
    _legend(figure, model.task.robots)
    return figure


def page(model: ConFlow, data: DemonstrationData, evaluation: Evaluation, split: SplitName) -> Figure:
    """A run at a glance: demonstrations of a split, what it starts from, and what it makes under every setting."""
    config, after = model.config, 2 + len(model.settings)
    figure, axes = _workspaces(-(-(after + 1) // 3), 3, after + 1)
    _judged(axes[0], data.held_out[split].x, model.trained, f"{SPLITS[split]} demonstrations")
    _judged(axes[1], evaluation.source_samples, model.trained, f"source: {config.source.kind}")
    _zoom_out(axes[1:2], evaluation.source_samples)
    _settings(axes[2:after], model, evaluation)
    _standing(axes[:after], model.task)
    _clearances(axes[after], evaluation.samples[NONE], model)
    axes[after].set_title("smallest clearance\nno guidance")
    _legend(figure, model.task.robots)
    figure.suptitle(f"{config.name}, preset {config.preset}, {SPLITS[split]} split")
    return figure


def methods(runs: Sequence[tuple[str, ConFlow, Evaluation]]) -> Figure:
    """Several runs, a row for each, under every setting."""
    columns = max(len(model.settings) for _, model, _ in runs)
    figure, axes = _workspaces(len(runs), columns)
    for i, (name, model, evaluation) in enumerate(runs):
        row, settings = axes[columns * i : columns * (i + 1)], len(model.settings)
        _settings(row[:settings], model, evaluation)
        _standing(row[:settings], model.task)
        for axis in row[settings:]:  # of a run with fewer settings than another
            axis.remove()
        row[0].set_ylabel(f"{name}\n\n{row[0].get_ylabel()}")
    _legend(figure, max((model.task.robots for _, model, _ in runs), key=lambda robots: robots.count))
    return figure


def flow(model: ConFlow, x_0: Tensor, ends: Tensor | None = None) -> Figure:
    """The ODE without guidance from samples x_0 (batch, T, D) of the source to trajectories, at six times t."""
    steps, solver = model.config.sample.steps, model.config.sample.solver
    figure, axes = _workspaces(2, 3)
    shown = [round(t * steps) for t in TIMES]
    x = {k: x for k, x in enumerate(states(model.field("none", ends), x_0, steps, solver)) if k in shown}
    for axis, k in zip(axes, shown, strict=True):
        _judged(axis, x[k], model.trained, f"$t = {k / steps:.2g}$")
    _zoom_out(axes, x_0)
    _standing(axes, model.task)
    _legend(figure, model.task.robots)
    return figure


def clearances(model: ConFlow, evaluation: Evaluation) -> Figure:
    """The smallest clearance of what training keeps, along s under every setting; below 0 it is violated."""
    settings = model.settings
    figure = Figure(figsize=(3.6 * len(settings), 3.9), layout="constrained")
    for axis, setting in zip(figure.subplots(1, len(settings), sharey=True), settings, strict=True):
        x = evaluation.samples[setting]
        _clearances(axis, x, model)
        axis.set_title(f"{titled(setting)}\n{_share(model.trained.violation(x))} in violation")
        axis.label_outer()
    handles = [
        Line2D([], [], color="#666666", label="feasible"),
        Line2D([], [], color=COLLISION, label=f"in violation (first {SHOWN} drawn)"),
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


def _workspaces(rows: int, columns: int, count: int | None = None) -> tuple[Figure, list[Axes]]:
    """So many panels, all of the grid by default."""
    figure = Figure(figsize=(3.6 * columns, 3.9 * rows + 0.5), layout="constrained")
    count = count or rows * columns
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(count)]
    for i, axis in enumerate(axes):
        axis.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal")
        axis.set_xlabel("x (workspace units)" if i >= count - columns else "")
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
    """Each setting's trajectories, judged by what the setting guides around."""
    for axis, setting in zip(axes, model.settings, strict=True):
        appears = [name for name in model.guided_around(setting) if name in model.u_c_at_inference]
        if not appears:
            _judged(axis, evaluation.samples[setting], model.trained, titled(setting))
            continue
        met = joined([model.judged[name] for name in appears])
        _judged(axis, evaluation.samples[setting], met, titled(setting), "hit it")
        _obstacles(axis, model.task.obstacles(), model.task.robots)
        axis.set_xlabel(
            f"hits unguided: {_share(met.violation(evaluation.samples[NONE]))}\n{axis.get_xlabel()}".strip()
        )


def _judged(axis: Axes, x: Tensor, constraint: Constraint, name: str, what: str = "in violation") -> None:
    """Trajectories under a title that says how many of all of them violate the constraint."""
    violates = constraint.violation(x)
    _trajectories(axis, x, violates, constraint)
    axis.set_title(f"{name}\n{_share(violates)} {what}")


def _share(violates: Tensor) -> str:
    return f"{int(violates.sum())} of {len(violates)} ({violates.float().mean():.1%})"


def _trajectories(axis: Axes, x: Tensor, violates: Tensor, constraint: Constraint) -> None:
    """The first trajectories, each robot's in its colour; those in violation on top, marked at the closest approach."""
    robots = constraint.robots
    if robots.count > NAMED:
        _crowd(axis, x[:SHOWN], violates[:SHOWN], constraint)
        return
    x, violates = x[: shown(robots)], violates[: shown(robots)]
    paths = seen_from_above(robots, x)
    for body in robots.traced:
        colour = ROBOTS[int(robots.owner[body]) % len(ROBOTS)]
        axis.add_collection(LineCollection(list(paths[~violates, :, body].numpy()), colors=colour, alpha=0.4, lw=0.9))
        axis.add_collection(LineCollection(list(paths[violates, :, body].numpy()), colors=COLLISION, alpha=0.9, lw=0.9))
        starts = paths[:, 0, body]
        axis.scatter(starts[:, 0], starts[:, 1], s=6, color=colour, zorder=3)
    contacts = _contacts(x, constraint)[violates]
    axis.scatter(contacts[:, 0], contacts[:, 1], marker="x", s=22, color="black", linewidth=0.9, zorder=4)


def shown(robots: Robots) -> int:
    """How many trajectories are drawn: fewer of several robots."""
    return min(SHOWN, 4 * SHOWN // robots.count**2)


def _crowd(axis: Axes, x: Tensor, violates: Tensor, constraint: Constraint) -> None:
    """Of many robots one trajectory, with the bodies where the least clearance is left; and all closest approaches."""
    if not len(x):
        return
    robots, waypoint = constraint.robots, int(constraint.clearance(x[:1])[0].argmin())
    path = seen_from_above(robots, x[:1])[0]
    colours = [ROBOTS[robot % len(ROBOTS)] for robot in robots.owner.tolist()]
    axis.add_collection(LineCollection(list(path.transpose(0, 1).numpy()), colors=colours, alpha=0.45, lw=0.7))
    for at, radius, colour, wrong in zip(
        path[waypoint].tolist(), robots.radii.tolist(), colours, _violating(x[:1], constraint, waypoint), strict=True
    ):
        axis.add_artist(Circle(at, radius, fc=COLLISION if wrong else colour, ec="white", lw=0.5, alpha=0.9, zorder=3))
    contacts = _contacts(x, constraint)[violates]
    axis.scatter(contacts[:, 0], contacts[:, 1], marker="x", s=14, color="black", linewidth=0.8, alpha=0.7, zorder=4)


def _violating(x: Tensor, constraint: Constraint, waypoint: int) -> list[bool]:
    """Which bodies of a trajectory (1, T, D) violate something at a waypoint."""
    c, pullback = constraint.vjp(x)
    violated = torch.zeros_like(c)
    violated[0, waypoint] = (c[0, waypoint] < 0).to(c)
    return [bool(moved) for moved in constraint.robots.moved(pullback(violated))[0, waypoint]]


def seen_from_above(robots: Robots, x: Tensor) -> Tensor:
    """The bodies' paths in the plane, (batch, T, bodies, 2); of those in space x and y."""
    return robots.points(x)[..., :2]


def _contacts(x: Tensor, constraint: Constraint) -> Tensor:
    """Where trajectories (batch, T, D) are closest to a violation, (batch, 2): amid the bodies that come so close."""
    terms = constraint.terms if isinstance(constraint, Sum) else [constraint]
    clearances = torch.stack([term.clearance(x) for term in terms])
    places = torch.stack([_closest(x, term, c.argmin(dim=1)) for term, c in zip(terms, clearances, strict=True)])
    return places[clearances.amin(dim=2).argmin(dim=0), torch.arange(len(x))]


def _closest(x: Tensor, constraint: Constraint, waypoint: Tensor) -> Tensor:
    """Amid the bodies at the waypoints (batch,) on which the smallest of the clearances there depends, (batch, 2)."""
    robots, each = constraint.robots, torch.arange(len(x))
    # Of two in one place neither has a direction to go; a hair apart they have.
    c, pullback = constraint.vjp(x + HAIR * torch.linspace(-1, 1, x.shape[2]))
    smallest = torch.zeros_like(c)
    smallest[each, waypoint, c[each, waypoint].argmin(dim=1)] = 1
    moved = robots.moved(pullback(smallest))[each, waypoint]
    moved |= ~moved.any(dim=1, keepdim=True)  # where it depends on none, amid all
    return (seen_from_above(robots, x)[each, waypoint] * moved[..., None]).sum(dim=1) / moved.sum(dim=1, keepdim=True)


def _clearances(axis: Axes, x: Tensor, model: ConFlow) -> None:
    x = x[:SHOWN]
    c, violates = model.trained.clearance(x), model.trained.violation(x)
    s = torch.linspace(0, 1, x.shape[1])
    for shown, colour in ((~violates, "#666666"), (violates, COLLISION)):
        axis.plot(s, c[shown].T, color=colour, alpha=0.5, lw=0.9)
    axis.axhline(0, color="black", ls="--", lw=1)
    axis.set(xlim=(0, 1), aspect="auto")
    axis.autoscale(axis="y")
    axis.set(xlabel="s (trajectory time)", ylabel="clearance")
    axis.set_box_aspect(1)
    axis.spines[["top", "right"]].set_visible(False)


def standing(task: Task) -> Sequence[tuple[float, float, float]]:
    """The obstacles (x, y, radius) that are there from the training on: all, where none appears at inference."""
    return () if task.constraints_at_inference() else task.obstacles()


def _standing(axes: Sequence[Axes], task: Task) -> None:
    for axis in axes:
        _obstacles(axis, standing(task), task.robots)
        for box in task.boxes():
            axis.add_patch(rounded(box))


def rounded(box: Box) -> FancyBboxPatch:
    """A box of a map."""
    inner = (box.x - box.width / 2 + box.rounding, box.y - box.height / 2 + box.rounding)
    size = (max(box.width - 2 * box.rounding, 1e-6), max(box.height - 2 * box.rounding, 1e-6))
    style = f"round,pad={box.rounding},rounding_size={box.rounding}" if box.rounding else "square,pad=0"
    return FancyBboxPatch(inner, *size, boxstyle=style, color=OBSTACLE, lw=0, zorder=0.5)


def _obstacles(axis: Axes, obstacles: Sequence[tuple[float, float, float]], robots: Robots) -> None:
    """Discs (x, y, radius), and around each the circle that the largest body's centre must not enter."""
    reach = float(robots.radii.max())
    for x, y, radius in obstacles:
        axis.add_patch(Circle((x, y), radius, color=OBSTACLE, zorder=2.5))
        axis.add_patch(Circle((x, y), radius + reach, fill=False, ls="--", color="black", lw=1, zorder=3))


def _legend(figure: Figure, robots: Robots) -> None:
    width = figure.get_figwidth()
    if robots.count > NAMED:
        handles, columns = _of_crowd(), int(width / 3.4)
    else:
        # The last column has the long entry, beside as many of the robots' as there is room for.
        handles, columns = _of_few(robots), 1 + int((width - 4.1) / 1.2)
    figure.legend(handles=handles, loc="outside lower center", ncols=min(columns, len(handles)), frameon=False)


def _of_few(robots: Robots) -> list[Line2D]:
    crossed = f"in violation, crossed where closest (first {shown(robots)} drawn)"
    return [
        *(Line2D([], [], color=ROBOTS[i % len(ROBOTS)], label=f"robot {i + 1}") for i in range(robots.count)),
        Line2D([], [], color=COLLISION, marker="x", markeredgecolor="black", label=crossed),
    ]


def _of_crowd() -> list[Line2D]:
    return [
        Line2D(
            [], [], ls="none", marker="o", ms=7, color=ROBOTS[0], label="first trajectory, when there is least room"
        ),
        Line2D([], [], ls="none", marker="o", ms=7, color=COLLISION, label="robots in violation then"),
        Line2D([], [], ls="none", marker="x", color="black", label=f"where each of the first {SHOWN} violates most"),
    ]
