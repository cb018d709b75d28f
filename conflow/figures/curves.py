"""Curves over guidance weight, solver steps and flow time."""

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from conflow.flow.sampler import Solver
from conflow.training.diagnostics import EVALUATIONS, Guidance, Solved, by_evaluations, collisions_by_weight
from conflow.training.metrics import quantile_interval, wilson
from conflow.training.module import ConFlow, Setting

# Okabe and Ito's palette, in other colours than the robots.
COLOURS: dict[Setting, str] = {"none": "#000000", "robot": "#E69F00", "obstacle": "#56B4E9"}
STYLES: dict[Setting, str] = {"none": ":", "robot": "-", "obstacle": "--"}
LABELS: dict[Setting, str] = {"none": "no guidance", "robot": "around robots", "obstacle": "around obstacle"}
SOLVERS: dict[Solver, str] = {"euler": "#0072B2", "midpoint": "#D55E00"}
FACTORS = (0.0, 0.1, 1.0, 3.0, 10.0, 30.0, 100.0)
BUDGETS = (2, 4, 8, 16, 32, 64, 128, 256)
MODES = 10
"""Of the source, the widest; all that demonstrations and correction have to tell is in them."""
MARK = "#666666"


def guidance_weight(model: ConFlow, x_0: Tensor, ends: Tensor | None = None) -> Figure:
    """Collision rates against the guidance weight, up to a hundred times the config's, with Wilson's intervals."""
    sample = model.config.sample
    figure = Figure(figsize=(9, 3.9), layout="constrained")
    panels: dict[Setting, tuple[float, str]] = {
        "robot": (sample.robot_weight, "robot-collision rate"),
        "obstacle": (sample.obstacle_weight, "object-collision rate"),
    }
    for axis, (setting, (configured, name)) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        # A config that does not guide is shown about the weight 1.
        weights = [factor * (configured or 1.0) for factor in FACTORS]
        counts = collisions_by_weight(model, setting, x_0, weights, ends)
        rate(axis, weights, counts, len(x_0), COLOURS[setting], name)
        axis.set_xscale("symlog", linthresh=weights[1])
        axis.set_xticks(weights, [f"{weight:g}" for weight in weights])
        axis.set_xticks([], minor=True)
        axis.set(xlim=(-weights[1] / 4, 1.4 * weights[-1]), xlabel=r"guidance weight $\lambda$", ylabel=name)
        axis.set_title(f"guided {LABELS[setting]}\n{len(x_0)} trajectories, band: 95 % Wilson")
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
    rates.set(ylabel="robot-collision rate", title=f"no guidance, {len(x_0)} trajectories\nband: 95 % Wilson")
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


def guidance(settings: Mapping[Setting, Guidance]) -> Figure:
    """How strong guidance is along t, what it does to the barriers, and how far it moves start and goal."""
    figure = Figure(figsize=(9, 7), layout="constrained")
    (ratio, drift), (robots, obstacle) = figure.subplots(2, 2)
    for setting, found in settings.items():
        look = {"color": COLOURS[setting], "ls": STYLES[setting], "label": LABELS[setting]}
        if setting != "none":
            ratio.plot(found.t, found.ratio, **look)
        robots.plot(found.t, found.robot_barrier, **look)
        obstacle.plot(found.t, found.obstacle_barrier, **look)
    _drift(drift, settings)
    ratio.set(title="guidance against flow", ylabel="|guidance| / $|v(x_t, t)|$")
    ratio.set_ylim(bottom=0)
    robots.set(title="barrier of the robots", ylabel="mean $C(x_t)$ (workspace units)")
    obstacle.set(title="barrier of the obstacle", ylabel="mean $C(x_t)$ (workspace units)")
    for axis in (ratio, robots, obstacle):
        axis.set(xlabel="flow time t", xlim=(0, 1))
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False)
    for axis in (robots, obstacle):
        axis.axhline(0, color=MARK, lw=0.8)
    return figure


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


def _drift(axis: Axes, settings: Mapping[Setting, Guidance]) -> None:
    """Bars of the drift at start and goal, a group for each setting that guides."""
    guiding = [setting for setting in settings if setting != "none"]
    for i, setting in enumerate(guiding):
        drifts = settings[setting].start_drift, settings[setting].end_drift
        middles = [0.4 * i - 0.2, 0.4 * i + 0.8]
        bars = axis.bar(middles, drifts, 0.36, color=COLOURS[setting], label=LABELS[setting])
        axis.bar_label(bars, fmt="%.2g")
    axis.set_xticks([0, 1], ["start", "goal"])
    axis.set(title="drift against the unguided sample", ylabel="mean distance (workspace units)")
    axis.margins(y=0.35)  # room for the legend above the bars
    axis.legend(frameon=False, loc="upper left")
    axis.spines[["top", "right"]].set_visible(False)


def _mark(axis: Axes, x: float, label: str) -> None:
    """A vertical line where the config stands."""
    axis.axvline(x, color=MARK, ls="--", lw=1)
    axis.annotate(
        label, (x, 0.03), xycoords=("data", "axes fraction"), rotation=90, color=MARK, ha="right", va="bottom"
    )
