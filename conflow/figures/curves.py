"""Curves over guidance weight, solver steps and flow time."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from conflow.flow.settings import Solver
from conflow.training.build import NONE
from conflow.training.diagnostics import EVALUATIONS, GuidanceTrace, Solved, by_evaluations, collisions_by_weight
from conflow.training.metrics import quantile_interval, wilson
from conflow.training.model import ConFlow

# Okabe and Ito's palette, in other colours than the robots.
COLOURS = ("#000000", "#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#0072B2", "#D55E00")
STYLES = (":", "-", "--", "-.")
SOLVERS: dict[Solver, str] = {"euler": "#0072B2", "midpoint": "#D55E00"}
FACTORS = (0.0, 0.1, 1.0, 3.0, 10.0, 30.0, 100.0)
BUDGETS = (2, 4, 8, 16, 32, 64, 128, 256)
MODES = 10
"""Of the source, the widest; all that demonstrations and correction have to tell is in them."""
MARK = "#666666"


def guidance_weight(model: ConFlow, x_0: Tensor, ends: Tensor | None = None) -> Figure:
    """Collision rates against the guidance weight, up to a hundred times the config's, with Wilson's intervals."""
    sample, settings = model.config.sample, list(model.task.settings())
    figure = Figure(figsize=(4.5 * len(settings), 3.9), layout="constrained")
    for i, (axis, setting) in enumerate(
        zip(figure.subplots(1, len(settings), squeeze=False)[0], settings, strict=True), 1
    ):
        guided = model.guided_around(setting)
        appears = any(name in model.u_c_at_inference for name in guided)
        configured = sample.obstacle_weight if appears else sample.robot_weight
        # A config that does not guide is shown about the weight 1.
        weights = [factor * (configured or 1.0) for factor in FACTORS]
        counts = collisions_by_weight(model, setting, x_0, weights, ends)
        name = f"{'- or '.join(guided)}-collision rate"
        rate(axis, weights, counts, len(x_0), COLOURS[i % len(COLOURS)], name)
        axis.set_xscale("symlog", linthresh=weights[1])
        axis.set_xticks(weights, [f"{weight:g}" for weight in weights])
        axis.set_xticks([], minor=True)
        axis.set(xlim=(-weights[1] / 4, 1.4 * weights[-1]), xlabel=r"guidance weight $\lambda$", ylabel=name)
        axis.set_title(f"guided around {setting}\n{len(x_0)} trajectories, band: 95 % Wilson")
        _mark(axis, configured, f"config {configured:g}")
    return figure


def solver_steps(model: ConFlow, x_0: Tensor, ends: Tensor | None = None) -> Figure:
    """Collision rate and smoothness without guidance against the network evaluations that the solver spends."""
    sample = model.config.sample
    figure = Figure(figsize=(9, 3.9), layout="constrained")
    rates, smooth = figure.subplots(1, 2)
    for solver, colour in SOLVERS.items():
        solved = by_evaluations(model, solver, x_0, BUDGETS, ends)
        evaluations = [one.evaluations for one in solved]
        rate(rates, evaluations, [one.collisions for one in solved], len(x_0), colour, solver)
        _median(smooth, solved, colour, solver)
    rates.set(
        ylabel="rate of violating what training keeps", title=f"no guidance, {len(x_0)} trajectories\nband: 95 % Wilson"
    )
    smooth.set(ylabel="smoothness (workspace units)", title="median second difference\nband: 95 % of order statistics")
    smooth.set_ylim(bottom=0)
    for axis in (rates, smooth):
        axis.set_xscale("log", base=2)
        axis.set_xticks(BUDGETS, [str(number) for number in BUDGETS])
        axis.set_xlabel("network evaluations per trajectory")
        _mark(axis, sample.steps * EVALUATIONS[sample.solver], f"config: {sample.solver}, {sample.steps} steps")
    rates.legend(title="solver", frameon=False)
    return figure


def taken_back(shares: Sequence[tuple[str, Tensor]]) -> Figure:
    """How much of a push along grad C the velocity takes back in each mode of the source, a line for each name."""
    figure = Figure(figsize=(8.6, 5.4), layout="constrained")
    axis = figure.subplots()
    for name, share in shares:
        axis.plot(range(1, 1 + len(share[:MODES])), share[:MODES], marker="o", ms=4, label=name)
    for value in (0, 1):
        axis.axhline(value, color=MARK, lw=0.8, ls=":")
    axis.set(
        xlabel=r"eigenvector of $\Sigma$, the widest first",
        ylabel=r"share of a push along $\nabla C$",
        title="what the velocity takes back by t = 1",
        xticks=range(1, 1 + MODES),
    )
    axis.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", frameon=False)
    return figure


def guidance(settings: Mapping[str, GuidanceTrace]) -> Figure:
    """How strong guidance is along t, how far it moves start and goal, and what it does to each barrier."""
    names = list(next(iter(settings.values())).barriers)
    rows = 1 + -(-len(names) // 2)
    figure = Figure(figsize=(9, 3.5 * rows), layout="constrained")
    ratio, drift, *panels = (figure.add_subplot(rows, 2, i + 1) for i in range(2 + len(names)))
    for i, (setting, found) in enumerate(settings.items()):
        look: dict[str, Any] = {
            "color": COLOURS[i % len(COLOURS)],
            "ls": STYLES[i % len(STYLES)],
            "label": _label(setting),
        }
        if setting != NONE:
            ratio.plot(found.t, found.ratio, **look)
        for axis, name in zip(panels, names, strict=True):
            axis.plot(found.t, found.barriers[name], **look)
    _drift(drift, settings)
    ratio.set(title="guidance against flow", ylabel="|guidance| / $|v(x_t, t)|$")
    ratio.set_ylim(bottom=0)
    for axis, name in zip(panels, names, strict=True):
        axis.set(title=f"barrier: {name}", ylabel="mean $C(x_t)$ (workspace units)")
        axis.axhline(0, color=MARK, lw=0.8)
    for axis in (ratio, *panels):
        axis.set(xlabel="flow time t", xlim=(0, 1))
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False)
    return figure


def _label(setting: str) -> str:
    return "no guidance" if setting == NONE else f"around {setting}"


def rate(axis: Axes, x: Sequence[float], counts: Sequence[int], total: int, colour: str, label: str) -> None:
    """A rate along x with its band of Wilson's intervals."""
    low, high = zip(*(wilson(count, total) for count in counts), strict=True)
    axis.fill_between(x, low, high, color=colour, alpha=0.25, lw=0)
    axis.plot(x, [count / total for count in counts], color=colour, marker="o", ms=4, label=label)
    axis.set_ylim(bottom=0)
    axis.spines[["top", "right"]].set_visible(False)


def _median(axis: Axes, solved: Sequence[Solved], colour: str, label: str) -> None:
    """The median smoothness along the evaluations, with its interval."""
    x = [one.evaluations for one in solved]
    low, high = zip(*(quantile_interval(one.smoothness, 0.5) for one in solved), strict=True)
    axis.fill_between(x, low, high, color=colour, alpha=0.25, lw=0)
    axis.plot(x, [float(one.smoothness.quantile(0.5)) for one in solved], color=colour, marker="o", ms=4, label=label)
    axis.spines[["top", "right"]].set_visible(False)


def _drift(axis: Axes, settings: Mapping[str, GuidanceTrace]) -> None:
    """Bars of the drift at start and goal, a group for each setting that guides."""
    guiding = [setting for setting in settings if setting != NONE]
    for i, setting in enumerate(guiding):
        drifts = settings[setting].start_drift, settings[setting].end_drift
        width = 0.8 / len(guiding)
        middles = [place + width * (i + 0.5) - 0.4 for place in (0, 1)]
        colour = COLOURS[(i + 1) % len(COLOURS)]
        bars = axis.bar(middles, drifts, 0.9 * width, color=colour, label=_label(setting))
        axis.bar_label(bars, fmt="%.2g")
    axis.set_xticks([0, 1], ["start", "goal"])
    axis.set(title="drift against the unguided sample", ylabel="mean distance (workspace units)")
    axis.margins(y=0.35)  # room for the legend above the bars
    axis.set_ylim(bottom=0)
    axis.legend(frameon=False, loc="upper left")
    axis.spines[["top", "right"]].set_visible(False)


def _mark(axis: Axes, x: float, label: str) -> None:
    """A vertical line where the config stands."""
    axis.axvline(x, color=MARK, ls="--", lw=1)
    axis.annotate(
        label, (x, 0.03), xycoords=("data", "axes fraction"), rotation=90, color=MARK, ha="right", va="bottom"
    )
