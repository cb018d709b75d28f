"""Arms in motion: their bodies at a few moments, and the ways of their hands, from the front and from above."""

from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from torch import Tensor

from conflow.figures.workspace import COLLISION, OBSTACLE, ROBOTS
from conflow.scene.arms import Arms

MOMENTS = 5
VIEWS = {"front": (0, 2), "top": (0, 1)}
"""The two axes that each view shows, of x, y and z in metres."""


def motion(
    robots: Arms, x: Tensor, feasible: Tensor, spheres: Sequence[Sequence[float]] = (), title: str = ""
) -> Figure:
    """The first of some trajectories at MOMENTS moments, later ones darker, with the ways of the hands in all of them.

    Args:
        robots: the arms.
        x: configurations, (num, T, D), in workspace units.
        feasible: of each trajectory, boolean (num,).
        spheres: obstacles (x, y, z, radius) in metres; of arms in the plane (x, y, radius).
        title: above it.
    """
    views = {name: axes for name, axes in VIEWS.items() if robots.axes > max(axes)}
    figure = Figure(figsize=(5.2 * len(views), 5.4), layout="constrained")
    figure.suptitle(title)
    moments = torch.linspace(0, x.shape[1] - 1, MOMENTS).round().long()
    bodies, hands = robots.points(x[:1, moments])[0], robots.hands(x)
    for axis, (name, axes) in zip(figure.subplots(1, len(views), squeeze=False)[0], views.items(), strict=True):
        for place in spheres:
            *at, radius = place
            axis.add_patch(Circle((at[axes[0]], at[axes[1]]), radius, color=OBSTACLE))
        for k, placed in enumerate(bodies[..., axes]):
            _bodies(axis, robots, placed, 0.12 + 0.5 * (k / (MOMENTS - 1)) ** 2)
        for way, kept in zip(hands[..., axes].flip(0), feasible.flip(0), strict=True):
            for arm in range(len(robots.chains)):
                axis.plot(*way[:, arm].T, color=ROBOTS[arm % len(ROBOTS)] if kept else COLLISION, lw=0.8, alpha=0.6)
        for arm in range(len(robots.chains)):
            axis.plot(*hands[0, :, arm][:, axes].T, color=ROBOTS[arm % len(ROBOTS)], lw=2.5)
        axis.set(aspect="equal", title=name, xlabel="x (m)", ylabel=f"{'xyz'[axes[1]]} (m)")
        axis.spines[["top", "right"]].set_visible(False)
        axis.autoscale_view()
    handles = [Line2D([], [], color=ROBOTS[k % len(ROBOTS)], label=f"robot {k + 1}") for k in range(robots.count)]
    handles.append(Line2D([], [], color=COLLISION, label="not feasible"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def _bodies(axis: Axes, robots: Arms, placed: Tensor, alpha: float) -> None:
    """All bodies at one moment, (bodies, 2)."""
    for arm in range(len(robots.chains)):
        own = robots.owner == arm
        circles = [
            Circle((at[0], at[1]), radius)
            for at, radius in zip(placed[own].tolist(), robots.radii[own].tolist(), strict=True)
        ]
        axis.add_collection(PatchCollection(circles, color=ROBOTS[arm % len(ROBOTS)], alpha=alpha, lw=0))
