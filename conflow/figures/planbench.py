"""Many robots: how many scenes are solved within how much time, and one plan in motion."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter
from torch import Tensor

from conflow.figures.workspace import rounded
from conflow.scene.settings import Box

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
TRAIL, STILL = 12, 6
"""Waypoints that a trail is long, and frames that start and goal are shown."""
Attempts = tuple[Sequence[float], Sequence[bool]]
"""Seconds of every attempt, and whether it solved its scene."""


def success(task: str, robots: int, methods: Mapping[str, Attempts]) -> Figure:
    """The share of scenes that are solved against the time that each may take, by method."""
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axis = figure.add_subplot(
        xscale="log", ylim=(-0.02, 1.02), xlabel="time a scene may take (s)", ylabel="scenes solved"
    )
    first, last = (end(end(seconds) for seconds, _ in methods.values()) for end in (min, max))
    for i, (name, (seconds, passed)) in enumerate(methods.items()):
        solved = sorted(second for second, good in zip(seconds, passed, strict=True) if good)
        share = [k / len(seconds) for k in range(len(solved) + 1)]
        axis.step(
            [first, *solved, last],
            [*share, share[-1]],
            where="post",
            color=COLOURS[i % len(COLOURS)],
            label=name,
            lw=1.8,
        )
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.set_title(f"{task}, {robots} robots, {len(next(iter(methods.values()))[0])} scenes")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, loc="best", fontsize=9)
    return figure


def animation(x: Tensor, radius: float, boxes: Sequence[Box], path: Path) -> None:
    """One plan x (T, 2 robots) of discs in motion, with their trails and the boxes of the map, as a GIF."""
    places = x.unflatten(1, (-1, 2)).numpy()
    colours = colormaps["hsv"](np.arange(places.shape[1]) / places.shape[1])
    figure = Figure(figsize=(3.2, 3.2))
    axis = figure.add_axes((0, 0, 1, 1), xlim=(-1.02, 1.02), ylim=(-1.02, 1.02), xticks=[], yticks=[])
    for box in boxes:
        axis.add_patch(rounded(box))
    trails = LineCollection([], colors=colours, lw=1, alpha=0.5)
    sizes = np.full(len(colours), 2 * radius)
    discs = EllipseCollection(sizes, sizes, 0 * sizes, units="xy", offsets=places[0], offset_transform=axis.transData)
    discs.set_facecolor(colours)
    for artist in (trails, discs):
        axis.add_collection(artist)

    def show(k: int) -> tuple[LineCollection, EllipseCollection]:
        trails.set_segments(list(places[max(0, k - TRAIL) : k + 1].swapaxes(0, 1)))
        discs.set_offsets(places[k])
        return trails, discs

    still = [0] * STILL + [*range(len(places))] + [len(places) - 1] * STILL
    FuncAnimation(figure, show, still).save(path, writer=PillowWriter(fps=16), dpi=80)
