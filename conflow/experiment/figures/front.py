"""What fewer collisions cost: the unguided rate against the distance to D+, of the records of published runs."""

import statistics
from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from conflow.experiment.metrics import wilson
from conflow.experiment.record import Record

METRIC = "test/none/"
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#882255")
MARKERS = "osD^vP*X<>pdh8"


def front(records: Sequence[Record]) -> Figure:
    """Unguided robot collisions, with 95 % intervals, against the energy distance to held-out D+.

    A point for each ablation and preset, over its seeds, and a line from one preset of an ablation to the other: the
    nearer to the lower left the better.
    """
    presets = sorted({one.preset for one in records})
    figure = Figure(figsize=(10.8, 6.2), layout="constrained")
    axis = figure.subplots()
    for i, (ablation, points) in enumerate(_points(records).items()):
        colour = COLOURS[i % len(COLOURS)]
        axis.plot(*zip(*((x, rate) for x, rate, _, _ in points.values()), strict=True), color=colour, lw=0.8, alpha=0.5)
        for preset, (x, rate, low, high) in points.items():
            spread = ([rate - low], [high - rate])
            look: dict[str, Any] = {
                "color": colour,
                "marker": MARKERS[presets.index(preset)],
                "label": f"{ablation}, {preset}",
            }
            axis.errorbar([x], [rate], yerr=spread, ms=6, capsize=2, lw=1, **look)
        # Where it collides least; neighbours in the alphabet are often neighbours here.
        x, rate, _, _ = min(points.values(), key=lambda point: point[1])
        place = (6, 3 if i % 2 else -10)
        axis.annotate(ablation, (x, rate), place, textcoords="offset points", fontsize=8, color=colour)
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


def _points(records: Sequence[Record]) -> dict[str, dict[str, tuple[float, float, float, float]]]:
    """By ablation and preset, over the seeds: mean energy distance, pooled rate, and Wilson's interval of it."""
    groups: dict[str, dict[str, list[dict[str, float]]]] = {}
    for one in records:
        if f"{METRIC}energy_distance" in one.metrics:
            groups.setdefault(one.ablation, {}).setdefault(one.preset, []).append(one.metrics)
    found: dict[str, dict[str, tuple[float, float, float, float]]] = {}
    for ablation, by_preset in sorted(groups.items()):
        for preset, runs in sorted(by_preset.items()):
            count, total = (sum(int(run[METRIC + key]) for run in runs) for key in ("robot_collision_count", "num"))
            distance = statistics.mean(run[f"{METRIC}energy_distance"] for run in runs)
            found.setdefault(ablation, {})[preset] = (distance, count / total, *wilson(count, total))
    return found
