"""What the pictures of the theory show, compared with numbers computed another way."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from rich.console import Console

from conflow.figures import explain, gallery
from conflow.figures.front import DISTANCE, RATE, front
from conflow.flow import source
from conflow.flow.correction import Correction, covariant, gaussian_filter
from conflow.results.claims import Claim
from conflow.results.comparison import Comparison
from conflow.results.tables import METHODS, Cell
from conflow.scene.constraint import Barrier
from conflow.training import config, explanation
from conflow.training.build import build_source
from conflow.training.closed_form import expected, minimiser, posterior
from conflow.training.config import Config
from conflow.training.explanation import Gap, clearing_time, clearing_times, demonstrations
from tests.conftest import Command
from tests.papers import label


@pytest.fixture(scope="module")
def settings() -> Config:
    """The paper's, with fewer demonstrations."""
    return config.load(["data.num=1500"])


@pytest.fixture(scope="module")
def gap(settings: Config) -> Gap:
    return Gap.of(settings)


def curve(axis: Axes, label: str) -> np.ndarray:
    """The values drawn under a label."""
    (line,) = (line for line in axis.lines if str(line.get_label()).startswith(label))
    return np.asarray(line.get_ydata())


def check_labels(figure: Figure) -> None:
    """Every axis says what it shows."""
    for axis in figure.axes:
        assert axis.get_ylabel()
        assert axis.get_xlabel() or axis.get_label() == "<colorbar>"
    assert figure.get_suptitle()


def test_the_minimiser_leaves_a_residual_that_no_function_of_x_t_explains(settings: Config) -> None:
    """The normal equations of least squares: E <phi(x_t), u_t + lambda M u^c(x_t) - v(x_t, t)> = 0 for every phi."""
    nominal = config.load(["data.num=300", "data.jitter=0"])
    x_1 = demonstrations(nominal).double()
    p_0, constraint = build_source(nominal.source, 32), label(nominal, 4)
    M, u_c, t = constraint.violation(x_1), Correction(constraint, gaussian_filter(32)), 0.4
    v = minimiser(p_0, x_1, M, u_c, 2.5)
    i = torch.randint(300, (4000,), generator=torch.Generator().manual_seed(0))
    z = torch.randn(4000, 30, 4, generator=torch.Generator().manual_seed(1)).double()
    x_0 = p_0.mean(p_0.observe(x_1[i])) + p_0.modes * p_0.variance.sqrt() @ z
    x_t = (1 - t) * x_0 + t * x_1[i]
    push = u_c(x_t.float()).double()
    found = v(x_t, torch.full((len(i),), t))
    residual = x_1[i] - x_0 + 2.5 * M[i][:, None, None] * push - found
    for phi in (x_t, found, push, x_t.square()):
        products = (phi * residual).sum(dim=(1, 2))
        assert abs(products.mean()) < 4 * products.std() / len(i) ** 0.5  # four standard errors, seeds fixed
    # With half of the correction the same would fail.
    products = (push * (residual + 1.25 * M.double().mean() * push)).sum(dim=(1, 2))
    assert products.mean() > 4 * products.std() / len(i) ** 0.5


def test_the_minimiser_without_correction_gives_the_demonstrations_back(monkeypatch: pytest.MonkeyPatch) -> None:
    nominal = config.load(["data.num=200", "data.jitter=0"])
    x_1 = demonstrations(nominal)
    p_0, constraint = build_source(nominal.source, 32), label(nominal, 4)
    M, u_c = constraint.violation(x_1), Correction(constraint, gaussian_filter(32))
    monkeypatch.setattr(explanation, "SAMPLES", 400)
    monkeypatch.setattr(explanation, "SAMPLE_STEPS", 25)
    end = explanation.sampled(p_0, x_1, minimiser(p_0, x_1, M, u_c, 0.0))[-1]
    nearest = torch.cdist(end.flatten(1), x_1.double().flatten(1)).amin(dim=1)
    assert nearest.median() < 1e-3
    # As often as they collide: a binomial of 400 has a standard deviation of 0.023.
    assert abs(constraint.violation(end).double().mean() - M.double().mean()) < 0.09


def test_the_papers_loss_minimised_exactly_avoids_collisions(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"PAIRS": 400, "SAMPLES": 100, "SAMPLE_STEPS": 40, "WEIGHTS": (0.0, 2.5)}.items():
        monkeypatch.setattr(explanation if name in vars(explanation) else explain, name, value)
    figure = explain.exact(config.load())
    rates, astray = figure.axes
    assert curve(rates, explain.PAPERS)[0] > 0.2
    assert curve(rates, explain.PAPERS)[1] < 0.08
    assert curve(astray, explain.PAPERS)[-1] < 0.2
    check_labels(figure)


@pytest.mark.parametrize("t", [0.0, 0.3, 0.8])
def test_posterior_of_a_gaussian(t: float) -> None:
    """For z_1 ~ N(0, 4): E[z_1 | z_t] = 4 t z_t / (4 t^2 + (1 - t)^2)."""
    z_1 = 2 * torch.special.ndtri((torch.arange(4000) + 0.5) / 4000)[:, None]
    z = torch.linspace(-1, 1, 7)[:, None]
    weights = posterior(z, z_1, t)
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(7))
    # The quantiles stand for the law up to its tails.
    torch.testing.assert_close(weights @ z_1, 4 * t * z / (4 * t**2 + (1 - t) ** 2), rtol=0, atol=2e-3)


def test_the_exact_flow_reproduces_the_gaps_of_the_demonstrations(gap: Gap) -> None:
    """Without correction: the collision rate of D, and all quantiles."""
    ends = gap.paths(0.0)[-1]
    assert gap.collision_rate(ends) == pytest.approx(gap.collision_rate(gap.g_1), abs=0.01)
    levels = torch.linspace(0.05, 0.95, 19)
    torch.testing.assert_close(ends.quantile(levels), gap.g_1.quantile(levels), rtol=0, atol=0.02)


def test_in_one_dimension_a_large_weight_leaves_no_collision(gap: Gap) -> None:
    assert gap.collision_rate(gap.paths(2.5)[-1]) < 0.01


def test_gaps_collide_and_are_pushed_as_the_constraint_says(settings: Config, gap: Gap) -> None:
    """The share of D- in g_1, and dg/dt = 2 dC/dc sign(g): both robots give way."""
    violates = label(settings, 4).violation(demonstrations(settings))
    assert gap.collision_rate(gap.g_1) == pytest.approx(float(violates.float().mean()), abs=0.02)
    g = torch.tensor([[-1.0], [-0.2], [0.1], [0.5]])
    slope = Barrier(gamma=settings.constraint.gamma).slope(g.abs() - settings.constraint.radius)
    torch.testing.assert_close(gap.push(g), 2 * slope * g.sign())


def test_the_picture_of_the_gap(settings: Config) -> None:
    figure = explain.gap(settings)
    check_labels(figure)
    rates = curve(figure.axes[3], "exact flow")
    assert rates[0] == pytest.approx(curve(figure.axes[3], "demonstrations")[0], abs=0.01)
    assert (np.diff(rates) <= 0).all()
    assert rates[-1] < 0.01


def test_shifts_in_the_sources_deviations_have_the_cameron_martin_norm(settings: Config) -> None:
    """|e_k^T u|^2 / lambda_k, summed over k, is u^T Sigma^-1 u."""
    paper = build_source(settings.source, 32)
    u = torch.zeros(3, 32, 4, dtype=torch.float64)
    u[:, 1:-1] = torch.randn(3, 30, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    inner = u[:, 1:-1]
    expected = (inner * torch.linalg.solve(paper.covariance[1:-1, 1:-1], inner)).sum(dim=1)
    # Sigma's condition number is 1e7.
    torch.testing.assert_close(explanation.in_deviations(paper, u).square().sum(dim=1), expected, rtol=1e-6, atol=0)


def test_the_filters_content_in_trailing_modes_is_orders_of_magnitude_larger(settings: Config) -> None:
    figure = explain.support(settings)
    check_labels(figure)
    filtered, shaped = curve(figure.axes[1], "filter"), curve(figure.axes[1], "covariant")
    assert filtered[0] == pytest.approx(shaped[0], rel=0.5)  # the one mode in which both push alike
    assert (filtered[8:] > 1e3 * shaped[8:]).all()
    assert filtered[4:8].min() > 1
    assert shaped.max() < 1


def test_widths_are_those_of_both_kernels(settings: Config) -> None:
    figure = explain.eigenvalues(settings)
    check_labels(figure)
    x = demonstrations(settings)
    feasible = x[~label(settings, 4).violation(x)]
    floor = settings.source.epsilon**0.5
    for length_scale, sigma_f in ((0.4, 1.0), source.fit_rbf(feasible, source.ENDPOINTS)):
        Sigma = source.cgp(32, length_scale, sigma_f).covariance.numpy()[1:-1, 1:-1]
        drawn = curve(figure.axes[0], rf"source, $\ell = {length_scale:.2f}$")
        np.testing.assert_allclose(drawn, np.sqrt(np.linalg.eigvalsh(Sigma)[::-1]), rtol=1e-5)
        np.testing.assert_allclose(drawn[8:], floor, rtol=0.05)
        assert curve(figure.axes[0], rf"$D^+$ in its modes, $\ell = {length_scale:.2f}$")[8:].max() < 0.1 * floor


def test_a_lone_demonstration_is_expected_from_everywhere(settings: Config) -> None:
    nominal = config.load(["data.num=10", "data.jitter=0"])
    x_1, cgp = demonstrations(nominal), build_source(settings.source, 32)
    assert torch.equal(expected(cgp, x_1[:1], 0.4).end, x_1[:1])
    start, late = expected(cgp, x_1, 0.0), expected(cgp, x_1, 0.99)
    torch.testing.assert_close(start.end, x_1.mean(dim=0).expand_as(x_1))  # nothing is known at t = 0
    torch.testing.assert_close(late.end, x_1)
    torch.testing.assert_close(late.x_t, 0.01 * start.x_t + 0.99 * x_1)


def test_the_predicted_end_collides_early_and_x_t_late(settings: Config) -> None:
    figure = explain.predicted_end(settings)
    check_labels(figure)
    shares, pushes, told = figure.axes
    at, end = curve(shares, "at $x_t$"), curve(shares, "at the predicted end")
    assert end[0] == 1  # the mean of all ways around each other leads through the middle
    assert end[-1] == 0
    assert (at[12:] > end[12:]).all()
    plain, weighted = curve(pushes, r"at the end: "), curve(pushes, r"at the end, times t")
    np.testing.assert_allclose(weighted, plain * np.arange(25) / 25, rtol=1e-5)
    best = curve(told, "$E[M")
    assert (best[10:] >= np.maximum(curve(told, "$x_t$"), curve(told, "the predicted"))[10:] - 0.03).all()


def test_a_clearing_time_is_inverse_to_the_scale(settings: Config) -> None:
    """And found without stepping over: half the step finds the same to a step."""
    x = demonstrations(settings)[:300]
    constraint = label(settings, 4)
    x, S = x[constraint.violation(x)], covariant(source.cgp(32).covariance)
    once = clearing_time(Correction(constraint, S), x)
    assert clearing_time(Correction(constraint, 2 * S), x, h=0.005) == pytest.approx(once / 2, abs=0.006)
    assert clearing_time(Correction(constraint, S), x, h=0.005) == pytest.approx(once, abs=0.011)
    cleared = clearing_times(settings, 32, 0.4)
    assert set(cleared) == set(explain.LOOKS)


def test_lambda_keeps_its_meaning_with_row_sums_alone(settings: Config) -> None:
    """Over T and length scale; each of the four times against a run with that very matrix."""
    few, many, long = (clearing_times(settings, *at) for at in ((16, 0.4), (64, 0.4), (32, 1.6)))
    assert many[explanation.ROW_SUM] == pytest.approx(few[explanation.ROW_SUM], rel=0.1)
    assert long[explanation.ROW_SUM] == pytest.approx(few[explanation.ROW_SUM], rel=0.15)
    for name in (explanation.PEAKED, explanation.SIGMA, explanation.FILTER):
        assert few[name] > 1.5 * many[name]
    assert long[explanation.SIGMA] > 50 * few[explanation.SIGMA]

    x = demonstrations(config.load(["data.num=1000"]))
    constraint, Sigma = label(settings, 4), source.cgp(32, 1.6).covariance
    x = x[constraint.violation(x)]
    for name, S in (
        (explanation.PEAKED, Sigma / Sigma.max()),
        (explanation.SIGMA, Sigma),
        (explanation.FILTER, gaussian_filter(32)),
    ):
        step = long[name] / 50
        assert clearing_time(Correction(constraint, S), x, step) == pytest.approx(long[name], rel=0.05)


def test_the_picture_of_lambda(settings: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(explain, "HORIZONS", (16, 32))
    monkeypatch.setattr(explain, "LENGTH_SCALES", (0.4, 0.8))
    figure = explain.lambda_scale(settings)
    assert figure.get_suptitle()
    for axis in figure.axes:
        assert axis.get_xlabel()
        assert len(axis.lines) == len(explain.LOOKS)
    # T = 32 and length scale 0.4 stand in both panels.
    for by_horizon, by_length in zip(*(axis.lines for axis in figure.axes), strict=True):
        assert np.asarray(by_horizon.get_ydata())[1] == np.asarray(by_length.get_ydata())[0]


def test_every_picture_is_written_and_announced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line a picture: its file and what it finds; drawn again, it is overwritten."""
    monkeypatch.chdir(tmp_path)
    names = ["gap", "support", "exact", "eigenvalues", "predicted_end", "lambda_scale"]

    def picture(settings: Config) -> Figure:
        figure = Figure(figsize=(1, 1))
        figure.suptitle(f"{settings.ablation}\nin two lines")
        return figure

    for name in names:
        monkeypatch.setattr(explain, name, picture)
    console = Console(record=True, width=140)
    for _ in range(2):
        explain.draw(config.load(), console)
    *lines, where = console.export_text().splitlines()[: len(names) + 1]
    assert lines == [f"{name}.png: cgp in two lines" for name in names]
    assert "runs/figures/explain" in where
    written = tmp_path / "runs" / "figures" / "explain"
    assert sorted(path.name for path in written.iterdir()) == sorted(f"{name}.png" for name in names)


def test_explain_takes_a_preset_alone(conflow: Command) -> None:
    for argument, said in {"seed=1": "seed: no such option, expected preset", "preset=quik": "mean quick?"}.items():
        answer = conflow("explain", argument)
        assert answer.returncode == 2
        assert said in answer.stderr
        assert answer.stderr.count("\n") == 1


def published(preset: str, *rates: tuple[str, int, float | None]) -> Comparison:
    """Of methods at a preset, how many of 1,000 collide and the energy distance."""
    cells = []
    for method, count, distance in rates:
        rate = Cell("3", method, RATE, None, count / 1000, None, None, 0, 1, 0, 1, 1, count, 1000, preset, "", None)
        cells += [rate] if distance is None else [rate, replace(rate, column=DISTANCE, value=distance)]
    return Comparison(preset, cells, [Claim("", "no runs", None, None, None, "")], {}, {}, "", {}, "", "test", [], [])


def test_the_front_has_a_point_for_each_method_and_preset() -> None:
    """Those without a distance are left out, and those of other tasks than the paper's."""
    quick = published("quick", (METHODS["cgp"], 301, 0.04), (METHODS["fm"], 270, None))
    other = replace(published("quick", ("ConFlow, task=social", 20, 0.1)), task="social")
    (axis,) = front([published("long", (METHODS["cgp"], 16, 0.0)), quick, other]).axes
    assert points(axis) == {
        "ConFlow (D+ and D-), quick": [pytest.approx([0.04, 0.301])],
        "ConFlow (D+ and D-), long": [pytest.approx([0.0, 0.016])],
    }
    assert {text.get_text() for text in axis.texts} == {"cgp"}


def test_without_published_runs_the_front_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    console = Console(width=200)
    with console.capture() as captured:
        gallery.draw_front(console)
    assert captured.get().startswith("front.png is left out; reference: expected records in runs/reference/runs")
    assert not Path("runs/figures").exists()


def points(axis: Axes) -> dict[object, list[list[float]]]:
    """What stands under each label."""
    bars = [container for container in axis.containers if isinstance(container, ErrorbarContainer)]
    return {bar.get_label(): np.asarray(bar.lines[0].get_xydata()).tolist() for bar in bars}
