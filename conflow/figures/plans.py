"""A picture of plans."""

from collections.abc import Sequence

import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from conflow.figures.arms import motion
from conflow.figures.workspace import COLLISION, NAMED, OBSTACLE, ROBOTS, rounded, seen_from_above, standing
from conflow.planner import Planner, Plans
from conflow.scene.arms import Arms
from conflow.scene.settings import Box

PER_ROW = 3
"""Entries of the legend in a row; more would be cut off."""


def picture(planner: Planner, plans: Plans, obstacles: Sequence[Sequence[float]] = ()) -> Figure:
    """The plans of one pair, each robot's in its colour, infeasible ones in another, and the best plan in bold.

    Of many robots the best plan alone, whose lines are enough to see; of arms its bodies, and the ways of all hands.

    Args:
        planner: whose plans they are.
        plans: in the user's units.
        obstacles: discs (x, y, radius) in the same, beside those that the task always has.
    """
    planner = planner.of_numbers(plans.x.shape[-1])
    title = f"{int(plans.feasible.sum())} of {len(plans.x)} plans are feasible"
    if isinstance(planner.model.task.robots, Arms):
        x = planner.to_workspace(plans.x)
        return motion(planner.model.task.robots, x, plans.feasible, obstacles, title)
    figure = Figure(figsize=(4.6, 5.4), layout="constrained")
    axis = figure.add_subplot(aspect="equal")
    task, reach = planner.model.task, 1.05 * planner.length
    middle, origin = planner.origin, torch.tensor(planner.origin)
    axis.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[-1] - reach, middle[-1] + reach))
    axis.set(xlabel="x", ylabel="y")
    axis.spines[["top", "right"]].set_visible(False)
    crowd = task.robots.count > NAMED
    best = "\nthe best one is drawn" if crowd else ""
    axis.set_title(f"{title}{best}")
    paths = planner.length * seen_from_above(task.robots, planner.to_workspace(plans.x)) + origin
    for body, robot in enumerate(task.robots.owner.tolist()):
        colour = ROBOTS[robot % len(ROBOTS)]
        for shown, drawn in () if crowd else ((plans.feasible, colour), (~plans.feasible, COLLISION)):
            axis.add_collection(LineCollection(list(paths[shown, :, body].numpy()), colors=drawn, alpha=0.4, lw=0.9))
        axis.plot(*paths[0, :, body].T, color=colour if plans.feasible[0] else COLLISION, lw=1 if crowd else 2.5)
        axis.plot(*paths[0, 0, body], "o", color=colour, zorder=3, label=f"robot {robot + 1}" * (not crowd))
        # A ring, so that in a swap it does not hide the other robot's start.
        axis.plot(*paths[0, -1, body], "o", color=colour, zorder=3, ms=11, mfc="none", mew=2)
    axis.plot([], [], color=COLLISION, label="not feasible")
    axis.plot([], [], "o", color="black", ms=11, mfc="none", mew=2, label="goal")
    always = [
        [*(planner.length * torch.tensor(place) + origin), planner.length * radius] for *place, radius in standing(task)
    ]
    for box in task.boxes():
        x, y = (planner.length * torch.tensor([box.x, box.y]) + origin).tolist()
        sizes = (planner.length * size for size in (box.width, box.height, box.rounding))
        axis.add_patch(rounded(Box(x, y, *sizes)))
    for x, y, radius in [*obstacles, *always]:
        axis.add_patch(Circle((x, y), radius, color=OBSTACLE, zorder=2.5))
    handles, labels = axis.get_legend_handles_labels()
    named = dict(zip(labels, handles, strict=True))  # each robot once, however many bodies it has
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=PER_ROW, frameon=False)
    return figure
