"""The source against Gaussian conditioning done in other ways: by precision matrices, by GPyTorch, by SciPy."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import gpytorch
import pytest
import torch
from scipy.stats import multivariate_normal
from torch import Tensor

from conflow.flow import source
from conflow.flow.correction import gaussian_filter
from conflow.flow.source import ENDPOINTS, Source, fit_rbf, rbf
from conflow.scene.tasks.passing import passing
from conflow.scene.tasks.social import social
from conflow.scene.tasks.swap import swap

T, D = 8, 2

observations = pytest.mark.parametrize(
    ("index", "noise"),
    [
        pytest.param((), (), id="nothing"),
        pytest.param(ENDPOINTS, (), id="endpoints"),
        pytest.param((0, 4, -1), (), id="via-point"),
        pytest.param((0, 4, -1), (0.0, 0.05, 0.0), id="noisy via-point"),
        pytest.param((2, 5), (0.1, 0.3), id="noise everywhere"),
    ],
)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def posterior(K: Tensor, index: Sequence[int], noise: Sequence[float], y: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and covariance of x ~ N(0, K) given noisy or exact values y (O, D), through the precision of x."""
    observed = torch.tensor(index, dtype=torch.long) % len(K)
    R = torch.tensor(noise or [0.0] * len(index), dtype=K.dtype)
    exact, vague = observed[R == 0], observed[R > 0]
    free = torch.tensor([i for i in range(len(K)) if i not in exact])
    Lambda = K.inverse()
    precision, information = Lambda.clone(), torch.zeros(len(K), y.shape[1], dtype=K.dtype)
    precision[vague, vague] += 1 / R[R > 0]
    information[vague] = y[R > 0] / R[R > 0, None]
    mean, covariance = torch.zeros_like(information), torch.zeros_like(K)
    mean[exact] = y[R == 0]
    covariance[free[:, None], free] = precision[free][:, free].inverse()
    mean[free] = covariance[free][:, free] @ (information[free] - Lambda[free][:, exact] @ y[R == 0])
    return mean, covariance


class Process(gpytorch.models.ExactGP):  # type: ignore[misc]
    """GPyTorch's Gaussian process with an RBF kernel and given observation variances."""

    def __init__(self, s: Tensor, y: Tensor, noise: Tensor, length_scale: float, sigma_f: float) -> None:
        super().__init__(s, y, gpytorch.likelihoods.FixedNoiseGaussianLikelihood(noise))
        self.mean = gpytorch.means.ZeroMean()
        self.kernel = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel()).double()
        # Tensors, because GPyTorch rounds a plain number to float32.
        self.kernel.base_kernel.lengthscale = torch.tensor(length_scale, dtype=torch.float64)
        self.kernel.outputscale = torch.tensor(sigma_f**2, dtype=torch.float64)

    def forward(self, s: Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean(s), self.kernel(s))


def test_the_gp_covariance_is_the_papers_formula() -> None:
    """K_ij = sigma_f^2 exp(-(s_i - s_j)^2 / (2 l^2)) + epsilon delta_ij on s_i = i / (T - 1)."""
    length_scale, sigma_f, epsilon = 0.3, 1.7, 1e-3
    expected = [
        [
            sigma_f**2 * math.exp(-(((i - j) / (T - 1)) ** 2) / (2 * length_scale**2)) + epsilon * (i == j)
            for j in range(T)
        ]
        for i in range(T)
    ]
    K = source.gp(T, length_scale, sigma_f, epsilon).covariance
    torch.testing.assert_close(K, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-14)  # float64 rounding


@observations
def test_the_moments_are_those_of_dense_conditioning(index: Sequence[int], noise: Sequence[float]) -> None:
    """W y and Sigma agree with the posterior computed from the precision matrix K^-1."""
    K = rbf(T, 0.4, 1.3, epsilon=1e-3)
    y = torch.randn(len(index), D, dtype=torch.float64, generator=seeded())
    conditioned = Source(K, index, noise)
    mean, covariance = posterior(K, index, noise, y)
    # K's condition number is 1e4, so inverting it costs four of float64's sixteen digits.
    torch.testing.assert_close(conditioned.mean(y[None])[0], mean, rtol=0, atol=1e-10)
    torch.testing.assert_close(conditioned.covariance, covariance, rtol=0, atol=1e-10)


@pytest.mark.parametrize("noise", [(0.0, 0.0, 0.0), (0.02, 0.05, 0.1)])
def test_the_moments_are_gpytorchs(noise: Sequence[float]) -> None:
    """Between the observations, the posterior is that of an ExactGP whose data carry the noise R + epsilon."""
    length_scale, sigma_f, epsilon, index = 0.4, 1.3, 1e-5, [0, 4, 7]
    s = torch.linspace(0, 1, T, dtype=torch.float64)
    y = torch.randn(len(index), dtype=torch.float64, generator=seeded())
    process = Process(s[index], y, torch.tensor(noise, dtype=torch.float64) + epsilon, length_scale, sigma_f).eval()
    between = [i for i in range(T) if i not in index]
    with torch.no_grad():
        expected = process(s[between])
    conditioned = Source(rbf(T, length_scale, sigma_f, epsilon), index, noise)
    # Two float64 Cholesky or LU solves of a matrix with condition number 1e5.
    torch.testing.assert_close(conditioned.mean(y[None, :, None])[0, between, 0], expected.mean, rtol=0, atol=1e-9)
    # GPyTorch's posterior is that of the process without its epsilon at the new waypoints.
    covariance = expected.covariance_matrix + epsilon * torch.eye(len(between), dtype=torch.float64)
    torch.testing.assert_close(conditioned.covariance[between][:, between], covariance, rtol=0, atol=1e-9)


@observations
def test_samples_have_the_sources_mean_and_covariance(index: Sequence[int], noise: Sequence[float]) -> None:
    """Residuals x_0 - W y have mean 0 and covariance Sigma, and the D dimensions are independent."""
    conditioned = Source(rbf(T, 0.4, 1.3, 1e-3), index, noise)
    N = 20_000
    y = torch.randn(N, len(index), D, generator=seeded(1))
    residual = (conditioned.sample(y, seeded(2)) - conditioned.mean(y)).mT.flatten(1).double()
    expected = torch.block_diag(*[conditioned.covariance] * D)
    variance = expected.diagonal()
    # Five standard errors of each of the 16 means and 136 covariances; 1e-6 is float32's rounding.
    assert bool((residual.mean(0).abs() <= 5 * (variance / N).sqrt() + 1e-6).all())
    standard_error = ((variance[:, None] * variance + expected**2) / N).sqrt()
    assert bool(((residual.mT @ residual / N - expected).abs() <= 5 * standard_error + 1e-6).all())


@pytest.mark.parametrize("batch", [1, 33, 2048])
@pytest.mark.parametrize("noise", [(), (0.0, 0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 0.0)])
def test_exact_observations_are_met_to_the_last_bit_and_noisy_ones_are_not(batch: int, noise: Sequence[float]) -> None:
    """Start, goal and exact via-points of samples and of the mean equal y in float32; noisy via-points do not."""
    conditioned = Source(rbf(32, 0.4, 1.0, 1e-6), (0, 3, 7, 11, 16, 20, 27, -1), noise)
    y = torch.rand(batch, 8, 4, generator=seeded()) * 2 - 1
    y[:, ::2] *= torch.tensor([0.0, 1e-12, 1e-6, 1.0])  # small values feel any rounding of the large ones
    met = conditioned.observe(conditioned.sample(y, seeded(1))) == y
    exact = torch.tensor(noise or [0.0] * 8) == 0
    assert bool(met[:, exact].all())
    assert torch.equal(conditioned.observe(conditioned.mean(y))[:, exact], y[:, exact])
    assert not bool(conditioned.covariance[conditioned.index[exact]].any())
    # With this seed: in 8192 draws there is a chance of 1e-3 for one to hit y's very float32.
    assert not bool(met[:, ~exact].any())


@pytest.mark.parametrize(
    ("unconditioned", "K"),
    [(source.gaussian(T), torch.eye(T, dtype=torch.float64)), (source.gp(T, 0.3, 2.0, 1e-4), rbf(T, 0.3, 2.0, 1e-4))],
    ids=["gaussian", "gp"],
)
def test_an_unconditioned_source_answers_the_same_calls(unconditioned: Source, K: Tensor) -> None:
    """It observes nothing, y (batch, 0, D), its mean is zero, its covariance the prior's, its samples differ."""
    x = torch.randn(5, T, D, generator=seeded())
    y = unconditioned.observe(x)
    assert y.shape == (5, 0, D)
    assert torch.equal(unconditioned.mean(y), torch.zeros(5, T, D))
    assert torch.equal(unconditioned.covariance, K)
    x_0 = unconditioned.sample(y, seeded())
    assert x_0.shape == x.shape
    assert len(x_0[:, 0, 0].unique()) == 5


def test_the_named_sources_are_the_papers() -> None:
    """p_GP and p_CGP are the default RBF process (l = 0.4, sigma_f = 1, epsilon = 1e-6), free and between endpoints."""
    K = rbf(32, 0.4, 1.0, 1e-6)
    assert torch.equal(source.gp(32).covariance, K)
    assert torch.equal(source.cgp(32).covariance, Source(K, (0, 31)).covariance)
    assert source.cgp(32).index.tolist() == [0, 31]


def test_the_order_of_the_observations_does_not_matter() -> None:
    """Observing (0, 4, -1) or (4, 7, 0), values and noise permuted alike, is the same distribution."""
    K = rbf(T, 0.4, 1.0, 1e-3)
    y = torch.randn(3, 3, D, dtype=torch.float64, generator=seeded())
    one, other = Source(K, (0, 4, -1), (0.0, 0.05, 0.2)), Source(K, (4, 7, 0), (0.05, 0.2, 0.0))
    # Solves of permuted float64 systems differ by rounding.
    torch.testing.assert_close(one.mean(y), other.mean(y[:, [1, 2, 0]]), rtol=0, atol=1e-12)
    torch.testing.assert_close(one.covariance, other.covariance, rtol=0, atol=1e-12)


def test_a_waypoint_that_is_observed_with_little_noise_is_almost_exact() -> None:
    """As the noise goes to zero the noisy posterior becomes the exact one."""
    K = rbf(T, 0.4, 1.0, 1e-3)
    exact, almost = Source(K, ENDPOINTS), Source(K, ENDPOINTS, (1e-9, 1e-9))
    # The moments move by the noise times W^2 / K_OO, of order 1.
    torch.testing.assert_close(almost.mean_map, exact.mean_map, rtol=0, atol=1e-8)
    torch.testing.assert_close(almost.covariance, exact.covariance, rtol=0, atol=1e-8)


@pytest.mark.parametrize("length_scale", [0.01, 0.4, 10.0])
@pytest.mark.parametrize("length", [3, 32, 512])
@pytest.mark.parametrize("named", [source.gp, source.cgp])
def test_extreme_kernels_factor(named: Callable[[int, float], Source], length: int, length_scale: float) -> None:
    """The sampling factor reproduces the covariance, L L^T = Sigma, from rough to nearly singular kernels."""
    built = named(length, length_scale)
    L = built.sampling_map[:, len(built.index) :].double()
    # L is stored in float32, whose relative rounding is 6e-8.
    atol = 5e-7 * float(built.covariance.max())
    torch.testing.assert_close(L @ L.mT, built.covariance, rtol=0, atol=atol)


@pytest.mark.parametrize("first", [(), ENDPOINTS, (2, 3)])
def test_conditioning_again_starts_from_the_prior(first: Sequence[int]) -> None:
    """Whatever a source is conditioned on, `condition` gives the dense posterior of K at the new waypoints alone."""
    K, index, noise = rbf(T, 0.4, 1.3, 1e-3), (0, 4, -1), (0.0, 0.05, 0.0)
    y = torch.randn(len(index), D, dtype=torch.float64, generator=seeded())
    again = Source(K, first).condition(index, noise)
    mean, covariance = posterior(K, index, noise, y)
    # K's condition number is 1e4, so inverting it costs four of float64's sixteen digits.
    torch.testing.assert_close(again.mean(y[None])[0], mean, rtol=0, atol=1e-10)
    torch.testing.assert_close(again.covariance, covariance, rtol=0, atol=1e-10)
    assert torch.equal(again.condition(first).covariance, Source(K, first).covariance)


def test_a_stiff_process_between_two_points_is_a_straight_line() -> None:
    """For l = 10 the mean's weights are 1 - s and s."""
    length_scale = 10.0
    s = torch.linspace(0, 1, 32, dtype=torch.float64)
    line = torch.stack([1 - s, s], dim=1)
    # The kernel's curvature bends the line by at most 1 / (8 l^2).
    torch.testing.assert_close(source.cgp(32, length_scale).mean_map, line, rtol=0, atol=1 / (8 * length_scale**2))


@pytest.mark.parametrize("length", [2, 3])
def test_a_source_that_is_conditioned_on_every_waypoint_returns_them(length: int) -> None:
    """Nothing is left to draw: x_0 = y."""
    y = torch.randn(4, length, D, generator=seeded())
    assert torch.equal(Source(rbf(length, 0.4, 1.0, 1e-6), range(length)).sample(y, seeded()), y)


@pytest.mark.parametrize(
    ("K", "index", "noise", "reason"),
    [
        pytest.param(torch.eye(5), (5,), (), "within the 5 waypoints", id="index too large"),
        pytest.param(torch.eye(5), (-6,), (), "within the 5 waypoints", id="index too small"),
        pytest.param(torch.eye(5), (0, -5), (), "at most once", id="the same waypoint by two names"),
        pytest.param(torch.eye(5), (0, 4), (0.1, -0.1), "variances", id="negative variance"),
        pytest.param(torch.eye(5), (0, 4), (0.1, math.nan), "variances", id="variance NaN"),
        pytest.param(torch.eye(5), (0, 4), (0.1,), "2 variances", id="a variance is missing"),
        pytest.param(torch.eye(5), (), (0.1,), "0 variances", id="a variance too many"),
        pytest.param(-torch.eye(5), (), (), "covariance", id="negative definite"),
        pytest.param(torch.ones(5, 5) - 2 * torch.eye(5), (), (), "covariance", id="indefinite"),
        pytest.param(-torch.eye(5), ENDPOINTS, (), "covariance", id="negative definite, conditioned"),
        pytest.param(
            torch.diag(torch.tensor([-1.0, 1, 1, 1, -1])),
            ENDPOINTS,
            (),
            "covariance",
            id="indefinite where it is conditioned",
        ),
        pytest.param(torch.eye(5) + 0.3 * torch.ones(5, 5).triu(1), (), (), "covariance", id="asymmetric"),
        pytest.param(torch.full((5, 5), math.nan), (), (), "covariance", id="NaN"),
        pytest.param(torch.ones(5, 5), ENDPOINTS, (), "covariance", id="observations that cannot differ"),
    ],
)
def test_what_is_no_gaussian_is_refused(K: Tensor, index: Sequence[int], noise: Sequence[float], reason: str) -> None:
    """A ValueError says what was expected."""
    with pytest.raises(ValueError, match=reason):
        Source(K, index, noise)


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def constants() -> dict[str, Tensor]:
    # From 64 waypoints on, eigenvectors of two threads differ from those of one.
    length_scale, sigma_f = fit_rbf(swap(50), ENDPOINTS)
    return source.cgp(64).state_dict() | {
        "filter": gaussian_filter(64, width=33),
        "fit": torch.tensor([length_scale, sigma_f], dtype=torch.float64),
        "swap": swap(50, T=64),
        "passing": passing(50, T=64),
        "social": social(50, T=64),
    }


def test_constants_have_the_same_bits_for_every_number_of_threads() -> None:
    """They are computed on one thread, and the caller's number is left as it was."""
    with threads(1):
        alone = constants()
    with threads(2):
        together = constants()
        assert torch.get_num_threads() == 2
    assert [name for name in alone if not torch.equal(alone[name], together[name])] == []


def test_a_second_thread_of_less_accuracy_changes_no_constant(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a busy machine, where half of a shared `exp` was off by 4.5e-10; here by what single precision shows."""
    expected = constants()

    def careless(accurate: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
        def function(x: Tensor) -> Tensor:
            error = torch.zeros(x.numel(), dtype=x.dtype)
            error[: x.numel() // 2] = 1e-5 * (torch.get_num_threads() > 1)
            return accurate(x) * (1 + error.view_as(x))

        return function

    for name in ("exp", "sin", "cos"):
        for owner in (torch, Tensor):
            monkeypatch.setattr(owner, name, careless(getattr(owner, name)))
    with threads(2):
        built = constants()
    assert [name for name in expected if not torch.equal(expected[name], built[name])] == []


def test_a_kernel_that_is_symmetric_to_rounding_is_symmetric() -> None:
    """No arithmetic promises more; the source's own matrices are symmetric to the last bit."""
    K = rbf(T, 0.4, 1.0, 1e-3)
    rounded = K * (1 + 4.5e-10 * torch.ones(T, T, dtype=torch.float64).triu(1))
    assert not torch.equal(rounded, rounded.mT)
    built = Source(rounded, ENDPOINTS)
    assert torch.equal(built.prior, built.prior.mT)
    # Half of the asymmetry, times the 1e3 that W may amplify it by.
    torch.testing.assert_close(built.covariance, Source(K, ENDPOINTS).covariance, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="expected a finite symmetric matrix"):
        Source(K + 1e-6 * torch.ones(T, T).triu(1))


def test_a_saved_source_draws_the_same_samples_when_reloaded() -> None:
    """The state alone determines the distribution: another kernel's source becomes the saved one."""
    saved, loaded = source.cgp(T, length_scale=0.4), source.cgp(T, length_scale=0.1)
    y = torch.randn(5, 2, D, generator=seeded())
    assert not torch.equal(loaded.sample(y, seeded(1)), saved.sample(y, seeded(1)))
    loaded.load_state_dict(saved.state_dict())
    assert torch.equal(loaded.sample(y, seeded(1)), saved.sample(y, seeded(1)))
    assert torch.equal(loaded.condition((0, 3, -1)).covariance, saved.condition((0, 3, -1)).covariance)
    assert not torch.equal(loaded.sample(y, seeded(1)), saved.sample(y, seeded(2)))


@pytest.mark.parametrize("index", [(), ENDPOINTS, (0, 7, -1)])
@pytest.mark.parametrize(("length_scale", "sigma_f"), [(0.4, 1.0), (0.15, 0.5)])
def test_fitting_recovers_the_kernel_that_drew_the_data(
    length_scale: float, sigma_f: float, index: Sequence[int]
) -> None:
    """The maximum-likelihood kernel of 4000 draws is the kernel they were drawn from."""
    drawn = source.gp(16, length_scale, sigma_f).sample(torch.zeros(2000, 0, 2), seeded())
    # Five standard errors: 4000 draws of 3 or more effective waypoints give 1 / sqrt(2 * 12000) = 0.6 % of sigma_f,
    # and of l, which every pair of neighbours measures, less.
    assert fit_rbf(drawn, index) == pytest.approx((length_scale, sigma_f), rel=0.03)


@pytest.mark.parametrize("index", [(), ENDPOINTS, (0, 5, -1)])
def test_the_fitted_kernel_is_the_most_likely_under_scipys_density(index: Sequence[int]) -> None:
    """No kernel nearby gives log p(x_F | x_O), summed by scipy.stats, a larger value."""
    length, epsilon = 10, 1e-4
    x = source.gp(length, 0.3, 0.8, epsilon).sample(torch.zeros(50, 0, D), seeded()).double()
    free = [i for i in range(length) if i % length not in [j % length for j in index]]

    def log_likelihood(length_scale: float, sigma_f: float) -> float:
        K = rbf(length, length_scale, sigma_f, epsilon)
        columns = x.mT.flatten(0, 1).mT
        mean, covariance = posterior(K, index, (), columns[list(index)])
        density = multivariate_normal(cov=covariance[free][:, free].numpy())
        return float(density.logpdf((columns - mean)[free].mT.numpy()).sum())

    length_scale, sigma_f = fit_rbf(x, index, epsilon)
    best = log_likelihood(length_scale, sigma_f)
    # A step of 0.1 % is some percent of a standard error: a maximum of anything else would not stand this.
    for factor in (0.999, 1.001):
        assert log_likelihood(factor * length_scale, sigma_f) < best
        assert log_likelihood(length_scale, factor * sigma_f) < best


def test_straight_demonstrations_give_a_usable_kernel() -> None:
    """The likelihood of straight lines grows with l for ever; the fit ends with a source that can be built."""
    x = swap(500, amplitudes=())
    length_scale, sigma_f = fit_rbf(x, ENDPOINTS)
    assert length_scale > 1
    fitted = source.cgp(32, length_scale, sigma_f)
    x_0 = fitted.sample(fitted.observe(x), seeded())
    # Of what is not a straight line the kernel gives about epsilon = 1e-6, a deviation of 1e-3.
    deviation = float(fitted.covariance.diagonal().max().sqrt())
    assert deviation < 2e-3
    assert float((x_0 - x).abs().max()) < 6 * deviation  # in none of 64,000 draws


def test_a_source_of_few_modes_has_their_covariance_and_keeps_them_when_conditioned_anew() -> None:
    """Sigma's best approximation of rank m (Eckart-Young): off by the next eigenvalue in the spectral norm."""
    K = rbf(32, 0.4, 1.0, 1e-6)
    full, few = Source(K, ENDPOINTS), Source(K, ENDPOINTS, modes=5)
    assert few.modes.shape == (32, 5)
    torch.testing.assert_close(few.modes.mT @ few.modes, torch.eye(5, dtype=torch.float64), rtol=0, atol=1e-12)
    error = torch.linalg.matrix_norm(full.covariance - few.covariance, 2)
    torch.testing.assert_close(error, full.variance[5], rtol=1e-6, atol=0)
    assert torch.equal(few.covariance[[0, -1]], torch.zeros(2, 32, dtype=torch.float64))
    assert few.condition((0, 10, -1)).modes.shape == (32, 5)
    assert Source(K, ENDPOINTS, modes=99).modes.shape == (32, 30)
