"""Why the corrections work or do not, in pictures. The numbers come from `training.explanation`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from torch import Tensor

from conflow.figures.curves import MARK, rate
from conflow.figures.workspace import COLLISION, ROBOTS, save
from conflow.flow.source import Source
from conflow.results import paper
from conflow.tracking import store
from conflow.training import explanation
from conflow.training.config import Config
from conflow.training.explanation import Ends, Gap, Shifts, Widths

# Okabe and Ito's palette.
FILTER, COVARIANT, PEAK, PLAIN = "#E69F00", "#0072B2", "#009E73", "#CC79A7"
FEASIBLE, SOURCE = ROBOTS[1], "#000000"
FEW = 0.01
LAMBDAS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 1.0)
HORIZONS = (16, 24, 32, 48, 64, 96, 128)
LENGTH_SCALES = (0.1, 0.2, 0.4, 0.8, 1.6)
SHAPES = 5
WEIGHTS = (0.0, 0.5, 1.0, 2.5, 5.0, 10.0)
PAPERS, PAPER_RATE = "filter, the paper's", paper.TABLE_1["cgp"][0]
OF_CORRECTION = {
    explanation.FILTER: (PAPERS, FILTER),
    explanation.CLOSEST: ("filter, closest approach alone", PLAIN),
    explanation.COVARIANT: ("covariant", COVARIANT),
}
"""Label and colour of each correction where trajectories flow."""
LOOKS: dict[str, tuple[str, dict[str, Any]]] = {
    explanation.ROW_SUM: (r"$\Sigma$ / largest row sum (ours)", {"color": COVARIANT, "ls": "-", "marker": "o"}),
    explanation.PEAKED: (r"$\Sigma$ / largest entry", {"color": PEAK, "ls": "--", "marker": "s"}),
    explanation.SIGMA: (r"$\Sigma$", {"color": PLAIN, "ls": "-.", "marker": "^"}),
    explanation.FILTER: ("Gaussian filter", {"color": FILTER, "ls": ":", "marker": "D"}),
}
"""Label and look of each matrix S whose clearing times are compared."""


def draw(settings: Config, console: Console) -> None:
    """Write all pictures under runs/figures/explain/ and print what each one finds."""
    folder = store.RUNS / "figures" / "explain"
    pictures: dict[str, Callable[[Config], Figure]] = {
        "gap": gap,
        "support": support,
        "exact": exact,
        "eigenvalues": eigenvalues,
        "predicted_end": predicted_end,
        "lambda_scale": lambda_scale,
    }
    for title, picture in pictures.items():
        figure = picture(settings)
        console.print(f"{title}.png: {' '.join(figure.get_suptitle().split())}", highlight=False, soft_wrap=True)
        save({title: figure}, folder)
    console.print(f"pictures are in {folder}", highlight=False)


def gap(settings: Config) -> Figure:
    """The gap between the robots when they pass, as a flow in one dimension, without and with the correction."""
    problem, lambda_c = Gap.of(settings), settings.correction.lambda_c
    paths = {weight: problem.paths(weight) for weight in sorted({*LAMBDAS, lambda_c})}
    rates = {weight: problem.collision_rate(g[-1]) for weight, g in paths.items()}
    figure = Figure(figsize=(9.5, 7.4), layout="constrained")
    fields, (densities, curve) = figure.subplots(2, 2)
    _fields(list(fields), problem, {weight: paths[weight] for weight in (0.0, lambda_c)})
    enough = min((weight for weight, rate in rates.items() if rate < FEW), default=lambda_c)
    _densities(densities, problem, {weight: paths[weight][-1] for weight in (0.0, enough, lambda_c)})
    curve.axhline(problem.collision_rate(problem.g_1), color=COLLISION, ls="--", lw=1, label="demonstrations")
    curve.plot(list(rates), list(rates.values()), color=COVARIANT, marker="o", ms=4, label="exact flow")
    curve.set(xlabel=r"$\lambda$ (workspace units per t)", ylabel="share of gaps in collision, |g| < r")
    curve.set_title("collisions after the flow")
    curve.set_ylim(bottom=0)
    _finish(curve)
    figure.suptitle(
        f"In one dimension the paper's correction works: {rates[0.0]:.1%} of gaps collide without it,\n"
        f"{rates[enough]:.1%} from λ = {enough:g} on, and what it moved gathers outside"
    )
    return figure


def support(settings: Config) -> Figure:
    """The filtered and the covariant correction of D-, along s and in the source's own standard deviations."""
    shifts = Shifts.of(settings)
    norms = shifts.norms()
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    along, modes, off = figure.subplots(1, 3)
    _along(along, {r"$\nabla C$": shifts.gradient[:, 1]} | {name: u[:, 1] for name, u in shifts.along.items()})
    _by_mode(modes, {name: z[..., 1].abs() for name, z in shifts.deviations.items()})
    _norms(off, norms)
    figure.suptitle(
        f"After one unit of t at λ = 1 the filter's bump lies {norms[explanation.FILTER].median():.0f} standard "
        f"deviations of the source away, the covariant one {norms[explanation.COVARIANT].median():.2f}"
    )
    return figure


def exact(settings: Config) -> Figure:
    """What the paper's loss asks for: collisions after the flow of its exact minimiser, and how far x_t goes astray."""
    flows, demonstrated = explanation.exact_flows(settings, WEIGHTS)
    lambda_c, samples = settings.correction.lambda_c, explanation.SAMPLES
    figure = Figure(figsize=(9.5, 4.2), layout="constrained")
    rates, astray = figure.subplots(1, 2)
    for correction, flow in flows.items():
        label, colour = OF_CORRECTION[correction]
        t = torch.arange(len(flow.astray)) / explanation.SAMPLE_STEPS
        astray.plot(t, flow.astray, color=colour, label=label)
        rate(rates, list(flow.collisions), list(flow.collisions.values()), samples, colour, label)
    rates.axhline(demonstrated, color=COLLISION, ls="--", lw=1, label="demonstrations")
    rates.axhline(PAPER_RATE, color=MARK, ls=":", lw=1, label="the paper's reported rate")
    rates.set(xlabel=r"weight $\lambda_c$", ylabel="robot-collision rate")
    rates.set_ylim(top=1.6 * rates.get_ylim()[1])  # room for the legend
    rates.set_title(f"{samples} samples of the exact flow\nband: 95 % Wilson")
    astray.set(xlabel="flow time t", xlim=(0, 1), yscale="log", ylabel="root mean square, in standard deviations")
    astray.set_title(rf"$x_t$ beyond the first {explanation.kept()} modes, $\lambda_c = {lambda_c:g}$")
    for axis in (rates, astray):
        _finish(axis, fontsize="small")
    figure.suptitle(
        f"The exact minimiser of the paper's loss collides in {flows[explanation.FILTER].collisions[lambda_c]} of "
        f"{samples} samples at λ = {lambda_c:g}:\nit brings back what the filter pushes astray, which a network has to "
        "learn"
    )
    return figure


def eigenvalues(settings: Config) -> Figure:
    """How wide the source is in each of its modes, how wide the demonstrations are there, and the modes along s."""
    kernels, kept = Widths.of(settings), explanation.kept()
    lengths = [rf"$\ell = {kernel.length_scale:.2f}$" for kernel in kernels]
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    widths, shapes = figure.subplots(1, 2)
    looks = (COVARIANT, "-", "the paper's"), (FILTER, "--", "most likely for $D^+$")
    for kernel, length, (colour, style, name) in zip(kernels, lengths, looks, strict=True):
        k, label = torch.arange(1, len(kernel.demonstrations) + 1), f"source, {length}: {name}"
        widths.plot(k, kernel.source.variance.sqrt(), color=colour, ls=style, marker="o", ms=4, label=label)
        label = f"$D^+$ in its modes, {length}"
        widths.plot(k, kernel.demonstrations, color=colour, ls=":", marker="x", label=label)
        _shapes(shapes, kernel.source, style)
    _widths(widths, settings.source.epsilon, kept)
    shapes.set_title(f"first modes along s: solid {lengths[0]}, dashed {lengths[1]}")
    figure.suptitle(
        f"{kept} modes hold all of D+ to within {max(kernel.left_out for kernel in kernels):.0e} workspace units;\n"
        "from there on the source is √ε wide and the demonstrations hold nothing more"
    )
    return figure


def predicted_end(settings: Config) -> Figure:
    """Who is in collision on the way, at x_t and at the end E[x_1 | x_t] that is expected from there."""
    ends = Ends.of(settings)
    t, at, end = ends.t, ends.at, ends.end
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    shares, pushes, told = figure.subplots(1, 3)
    shares.plot(t, at, color=FILTER, ls="--", label="at $x_t$")
    shares.plot(t, end, color=COVARIANT, label=r"at the predicted end $E[x_1 | x_t]$")
    shares.set(ylabel="share in collision", title="pairs with a feasible $x_1$, $D^+$", ylim=(0, 1.02))
    _pushes(pushes, ends)
    _told(told, ends)
    for axis in (shares, pushes, told):
        axis.set(xlabel="flow time t", xlim=(0, 1))
        _finish(axis, fontsize="small")
    best, even = int((at - end).argmax()), int((end < at).int().argmax())
    figure.suptitle(
        f"At t = {t[best]:.2f}, {at[best]:.0%} of feasible ways collide at x_t, {end[best]:.0%} at the predicted end;\n"
        f"before t = {t[even]:.2f} more of the ends do, hence the weight t"
    )
    return figure


def lambda_scale(settings: Config) -> Figure:
    """The time in which a correction takes D- out of collision, by its scale, number of waypoints and length scale."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    ell = settings.source.length_scale
    by_horizon = [explanation.clearing_times(settings, T, ell) for T in HORIZONS]
    by_length = [explanation.clearing_times(settings, settings.data.horizon, length) for length in LENGTH_SCALES]
    spans = {name: _span([times[name] for times in (*by_horizon, *by_length)]) for name in LOOKS}
    for axis, at, times in zip(axes, (HORIZONS, LENGTH_SCALES), (by_horizon, by_length), strict=True):
        _clearing(axis, at, times, spans)
    axes[0].set(xlabel="waypoints T", title=rf"length scale $\ell = {ell:g}$")
    axes[0].set_ylabel(rf"$\lambda t$ to clear {explanation.CLEARED:.0%} of $D^-$ (workspace units)")
    axes[1].set(xlabel=r"length scale $\ell$ (of s)", title=f"T = {settings.data.horizon} waypoints")
    _finish(axes[0], fontsize="small", title="largest / smallest of both panels", alignment="left")
    figure.suptitle(
        f"λ means the same within a factor of {spans[explanation.ROW_SUM]:.1f} with Σ scaled by its row sums, "
        f"of {spans[explanation.PEAKED]:.1f} by its largest entry, of {spans[explanation.SIGMA]:.0f} as it is"
    )
    return figure


def _fields(axes: Sequence[Axes], problem: Gap, paths: Mapping[float, Tensor]) -> None:
    """The field over t and g in colour, a panel for each weight, with some paths through it."""
    t, g = torch.linspace(0, 1, explanation.GAP_STEPS + 1), torch.linspace(-2, 2, 201)
    v = {weight: problem.velocities(t[:-1], g, weight) for weight in paths}
    # Outside the demonstrations the field grows like 1 / (1 - t) and would leave no colour for the rest.
    limit = max(float(one[g.abs() < 1].abs().max()) for one in v.values())
    for axis, (weight, path) in zip(axes, paths.items(), strict=True):
        grid = t[:-1].numpy(), g.numpy(), v[weight].numpy()
        image = axis.pcolormesh(*grid, cmap="PuOr", vmin=-limit, vmax=limit, shading="nearest")
        axis.plot(t, path[:, explanation.PARTICLES // 80 :: explanation.PARTICLES // 40], color="black", lw=0.6)
        for side in (-problem.radius, problem.radius):
            axis.axhline(side, color=COLLISION, ls="--", lw=1.2)
        axis.set(xlabel="flow time t", ylabel="signed gap g (workspace units)", xlim=(0, 1), ylim=(-2, 2))
        axis.set_title(rf"exact field and paths, $\lambda = {weight:g}$")
    axes[0].figure.colorbar(image, ax=axes, label="dg/dt (workspace units per t)", extend="both")


def _densities(axis: Axes, problem: Gap, ends: Mapping[float, Tensor]) -> None:
    """The gaps of demonstrations and of where the flow ends, and the density of the source."""
    bins = torch.linspace(-2, 2, 81).tolist()
    share = torch.full_like(problem.g_1, 1 / (len(problem.g_1) * (bins[1] - bins[0])))
    inside = problem.violates(problem.g_1)
    for chosen, colour, name in ((~inside, FEASIBLE, "$D^+$"), (inside, COLLISION, "$D^-$")):
        axis.hist(problem.g_1[chosen], bins=bins, weights=share[chosen], color=colour, alpha=0.5, label=name)
    for (weight, g), colour in zip(ends.items(), (PLAIN, ROBOTS[3], COVARIANT), strict=False):
        label = rf"flow, $\lambda = {weight:g}$"
        axis.hist(g, bins=bins, density=True, histtype="step", color=colour, lw=1.4, label=label)
    normal = torch.distributions.Normal(0.0, problem.sd)
    axis.plot(bins, normal.log_prob(torch.tensor(bins)).exp(), color=SOURCE, ls=":", label="source")
    axis.set(xlabel="signed gap g (workspace units)", ylabel="density (1 / workspace unit)", xlim=(-2, 2))
    axis.set_title("where the flow ends")
    axis.set_ylim(top=1.4 * axis.get_ylim()[1])
    _finish(axis, ncols=2, loc="upper center", fontsize="small")


def _along(axis: Axes, shifts: Mapping[str, Tensor]) -> None:
    """One demonstration's gradient and corrections (T,) along s."""
    for (name, u), colour in zip(shifts.items(), (MARK, FILTER, COVARIANT), strict=True):
        axis.plot(torch.linspace(0, 1, len(u)), u, color=colour, marker=".", label=name)
    axis.set(xlabel="s (trajectory time)", ylabel=r"robot 1 in y at $\lambda = 1$ (workspace units per t)")
    axis.set_title("one colliding demonstration")
    _finish(axis)


def _by_mode(axis: Axes, values: Mapping[str, Tensor]) -> None:
    """Median over the batch and a band of the middle 90 % of values (batch, m), by mode."""
    for (name, z), colour in zip(values.items(), (FILTER, COVARIANT), strict=True):
        k = torch.arange(1, z.shape[1] + 1)
        low, median, high = z.quantile(torch.tensor([0.05, 0.5, 0.95], dtype=z.dtype), dim=0)
        axis.fill_between(k, low, high, color=colour, alpha=0.25, lw=0)
        axis.plot(k, median, color=colour, marker="o", ms=4, label=name)
    axis.axhline(1, color=MARK, lw=0.8)
    axis.set(yscale="log", xlabel="mode k", ylabel=r"$|e_k^\top u^c|\ /\ \sigma_k$ (standard deviations)")
    axis.set_title("robot 1 in y by mode of the source\nmedian and 5 to 95 % of $D^-$")
    _finish(axis)


def _norms(axis: Axes, values: Mapping[str, Tensor]) -> None:
    """How far off shifts (batch,) are in all modes and dimensions."""
    bins = torch.logspace(-2, 3, 61).tolist()
    for (name, norm), colour in zip(values.items(), (FILTER, COVARIANT), strict=True):
        axis.hist(norm, bins=bins, color=colour, alpha=0.7, label=f"{name}, median {norm.median():.3g}")
    axis.set(xscale="log", xlabel="Cameron-Martin norm (standard deviations)", ylabel="demonstrations")
    axis.set_title(f"all modes and dimensions\n{len(norm)} demonstrations of $D^-$")
    _finish(axis)


def _widths(axis: Axes, epsilon: float, kept: int) -> None:
    """Label the widths by mode, with the kernel's white part and the modes that are kept."""
    floor = epsilon**0.5
    axis.axhline(floor, color=MARK, lw=0.8)
    axis.annotate(r"$\sqrt{\epsilon}$: the kernel's white part", (kept + 2, floor), (0, 4), "data", "offset points")
    axis.axvline(kept + 0.5, color=MARK, ls="--", lw=1)
    where = "data", "axes fraction"
    axis.annotate(f"{kept} modes kept", (kept + 0.5, 0.03), (-3, 0), where, "offset points", ha="right", color=MARK)
    axis.set(yscale="log", xlabel="mode k", ylabel=r"$\sigma_k$, root mean square of $D^+$ (workspace units)")
    # What lies below is the rounding of the demonstrations to float32.
    axis.set_ylim(bottom=1e-4 * floor)
    axis.set_title("width by mode")
    _finish(axis, fontsize="small")


def _shapes(axis: Axes, source: Source, style: str) -> None:
    """The first eigenvectors along s, their arbitrary signs chosen so that they begin upwards."""
    E = source.modes * source.modes[1].sign()
    for j in range(SHAPES):
        label = f"k = {j + 1}" if style == "-" else None
        colour = colormaps["viridis"](0.9 * j / (SHAPES - 1))
        axis.plot(torch.linspace(0, 1, len(E)), E[:, j], color=colour, ls=style, label=label)
    axis.set(xlabel="s (trajectory time)", ylabel="eigenvector $e_k$ (of length 1)")
    axis.set_ylim(top=1.3 * float(E[:, :SHAPES].max()))
    _finish(axis, ncols=SHAPES, loc="upper center", fontsize="small", columnspacing=1, handlelength=1)


def _pushes(axis: Axes, ends: Ends) -> None:
    """The push on pairs that need none, at both places, without and with the weight t, and its integral over t."""
    t = ends.t
    for push, colour, name in ((ends.push_at, FILTER, "at $x_t$"), (ends.push_end, COVARIANT, "at the end")):
        for weight, style, weighted in ((torch.ones_like(t), ":", ""), (t, "-", ", times t")):
            label = rf"{name}{weighted}: $\int dt$ = {float((weight * push).mean()):.3f}"
            axis.plot(t, weight * push, color=colour, ls=style, label=label)
    axis.axhline(ends.push_1, color=MARK, lw=0.8, ls="--", label="at $x_1$: the softplus's tail")
    axis.set(ylabel=r"mean $\max_s |u^c|$ at $\lambda = 1$ (workspace units per t)")
    axis.set_title("push on the same pairs, which need none")
    axis.set_ylim(0, 1.7 * float(ends.push_end.max()))  # room for the legend


def _told(axis: Axes, ends: Ends) -> None:
    """How well three signs tell pairs with a colliding x_1 from the others."""
    for tells, colour, style, name in (
        (ends.at_tells, FILTER, "--", "$x_t$ collides"),
        (ends.end_tells, COVARIANT, "-", "the predicted end collides"),
        (ends.mask_tells, MARK, "-.", r"$E[M | x_t] > E[M]$, the paper's mask: best"),
    ):
        axis.plot(ends.t, tells, color=colour, ls=style, label=name)
    axis.set(ylabel="share among $D^-$ minus share among $D^+$", title="all pairs: signs that $x_1$ collides")
    axis.set_ylim(top=1.4)  # room for the legend
    axis.set_yticks([0, 0.5, 1])


def _clearing(
    axis: Axes, at: Sequence[float], times: Sequence[Mapping[str, float]], spans: Mapping[str, float]
) -> None:
    """A line for each matrix S over the number of waypoints or the length scale."""
    for name, (label, look) in LOOKS.items():
        axis.plot(at, [one[name] for one in times], ms=4, label=f"{label}: {spans[name]:.3g}", **look)
    axis.set(xscale="log", yscale="log")
    axis.set_xticks(at, [f"{x:g}" for x in at])
    axis.set_xticks([], minor=True)
    axis.spines[["top", "right"]].set_visible(False)


def _span(values: Sequence[float]) -> float:
    return max(values) / min(values)


def _finish(axis: Axes, **legend: Any) -> None:
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, **legend)
