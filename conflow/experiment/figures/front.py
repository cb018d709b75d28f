"""What fewer collisions cost: the rate of finished runs against lambda, and against the distance to D+."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mlflow.entities import Run

from conflow.experiment.metrics import wilson

METRIC = "test/none/"
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#882255")
MARKERS = "osD^vP*X<>pdh8"


def front(runs: Sequence[Run]) -> Figure:
    """Unguided robot collisions of runs on the same demonstrations, with 95 % intervals.

    Left: against the weight lambda of the correction, one curve for each method of which several weights were
    trained. Right: against the energy distance to held-out D+, for every method: the nearer to the corner the better.
    """
    figure = Figure(figsize=(10.8, 4.6), layout="constrained")
    weights, distances = figure.subplots(1, 2)
    series = _series([run for run in runs if f"{METRIC}energy_distance" in run.data.metrics])
    for i, (name, members) in enumerate(series.items()):
        look = {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)], "ms": 5, "label": name}
        several = len({_weight(run) for run in members}) > 1
        if several:
            _errorbar(weights, members, [_weight(run) for run in members], {**look, "ls": "-"})
        _errorbar(distances, members, [run.data.metrics[f"{METRIC}energy_distance"] for run in members], look)
    weights.set_xscale("symlog", linthresh=1)
    weights.set(xlabel=r"weight $\lambda_c$ of the correction", title="collisions against the weight")
    distances.set_xscale("symlog", linthresh=0.01)
    distances.axvline(0, color="#666666", lw=0.8)
    distances.set(xlabel="energy distance to held-out $D^+$ (workspace units)", title="what they cost")
    for axis in (weights, distances):
        axis.set_yscale("symlog", linthresh=1e-3)
        axis.set(ylabel="robot-collision rate, no guidance", ylim=(-1e-4, 1))
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(*distances.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _series(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs of one method, that is of one config but for seed and weight, in order of the weight."""
    series: dict[str, list[Run]] = {}
    for run in sorted(runs, key=_weight):
        at = " at x_t" if run.data.params["correction.at"] == "point" and run.data.tags["ablation"] == "plus" else ""
        series.setdefault(run.data.tags["ablation"] + at, []).append(run)
    return dict(sorted(series.items()))


def _weight(run: Run) -> float:
    return float(run.data.params["correction.lambda_c"])


def _errorbar(axis: Axes, runs: Sequence[Run], x: Sequence[float], look: Mapping[str, Any]) -> None:
    rates, below, above = [], [], []
    for run in runs:
        count, total = (int(run.data.metrics[f"{METRIC}{key}"]) for key in ("robot_collision_count", "num"))
        low, high = wilson(count, total)
        rates.append(count / total)
        below.append(count / total - low)
        above.append(high - count / total)
    axis.errorbar(x, rates, yerr=(below, above), **{"ls": "", "lw": 1, "capsize": 2, **look})
