"""What fewer collisions cost: the unguided rate against the distance to D+, of published runs."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from conflow.results.comparison import Comparison
from conflow.results.tables import GUARDS, METHODS, Cell
from conflow.training.config import PAPERS_TASK

RATE, DISTANCE, *_ = GUARDS.values()
SHORT = {method: ablation for ablation, method in METHODS.items()}
"""A method by its ablation: the names of the tables would cover each other."""
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#882255")
MARKERS = "osD^vP*X<>pdh8"


def front(published: Sequence[Comparison]) -> Figure:
    """Unguided robot collisions, with 95 % intervals, against the energy distance to held-out D+, on the paper's task.

    Intervals are over seeds; of one seed, within its network.
    A point for each method and preset, over its seeds, and a line from one preset of a method to the other: the
    nearer to the lower left the better.
    """
    comparisons = [one for one in published if one.task == PAPERS_TASK]
    presets = sorted(one.preset for one in comparisons if one.claims)
    figure = Figure(figsize=(10.8, 6.2), layout="constrained")
    axis = figure.subplots()
    for i, (method, points) in enumerate(_points(comparisons).items()):
        colour = COLOURS[i % len(COLOURS)]
        line = zip(*((distance.value, rate.value) for distance, rate in points.values()), strict=True)
        axis.plot(*line, color=colour, lw=0.8, alpha=0.5)
        for preset, (distance, rate) in points.items():
            low, high = rate.interval
            assert low is not None
            assert high is not None
            spread = ([rate.value - low], [high - rate.value])
            look: dict[str, Any] = {
                "color": colour,
                "marker": MARKERS[presets.index(preset)],
                "label": f"{method}, {preset}",
            }
            axis.errorbar([distance.value], [rate.value], yerr=spread, ms=6, capsize=2, lw=1, **look)
        # Where it collides least; neighbours in the list are often neighbours here.
        distance, rate = min(points.values(), key=lambda point: point[1].value)
        place = (6, 3 if i % 2 else -10)
        axis.annotate(
            SHORT.get(method, method),
            (distance.value, rate.value),
            place,
            textcoords="offset points",
            fontsize=8,
            color=colour,
        )
    axis.set_xscale("symlog", linthresh=0.01)
    axis.set_yscale("symlog", linthresh=1e-3)
    axis.axvline(0, color="#666666", lw=0.8)
    axis.set(
        xlabel="energy distance to held-out $D^+$ (workspace units)",
        ylabel="robot-collision rate, no guidance",
        ylim=(-1e-4, 1),
        title="what fewer collisions cost",
    )
    axis.spines[["top", "right"]].set_visible(False)
    legend = [
        Line2D([], [], color="#666666", marker=marker, ls="", label=f"preset {preset}")
        for marker, preset in zip(MARKERS, presets, strict=False)
    ]
    figure.legend(handles=legend, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _points(comparisons: Sequence[Comparison]) -> dict[str, dict[str, tuple[Cell, Cell]]]:
    """By method and preset the cells of the energy distance and of the rate, where there are both."""
    found: dict[str, dict[str, tuple[Cell, Cell]]] = {}
    for one in comparisons:
        cells = {(cell.row, cell.column): cell for cell in one.cells if cell.table == "3" and not cell.without_model}
        for method in dict.fromkeys(row for row, _ in cells):
            if {(method, DISTANCE), (method, RATE)} <= cells.keys():
                found.setdefault(method, {})[one.preset] = (cells[method, DISTANCE], cells[method, RATE])
    return found
