"""The Gaussian process at the edges of what may be asked for: it factors, in float64, or says why it cannot."""

import itertools

import pytest
import torch
from torch import Tensor

from conflow.flow.settings import Source as Settings
from conflow.flow.source import ENDPOINTS, Source, fit_rbf, rbf
from conflow.scene.tasks.swap import swap
from conflow.training.build import build_source

LENGTH_SCALES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
LENGTHS = (2, 3, 4, 5, 8, 16, 31, 32, 33, 64, 128, 512)


def assert_factored(source: Source) -> None:
    """Finite numbers, L L^T = Sigma, and rows of zeros where x_0 is exactly y."""
    observations = len(source.index)
    assert bool(source.sampling_map.isfinite().all())
    assert source.mean_map.dtype == source.covariance.dtype == torch.float64
    L = source.modes * source.variance.sqrt()
    # Rounding of a float64 decomposition, of which the largest eigenvalue is at most T times the largest variance.
    T = len(source.prior)
    torch.testing.assert_close(L @ L.mT, source.covariance, rtol=0, atol=T * 1e-14 * float(source.prior.max()))
    assert not bool(source.sampling_map[source.index, observations:].any())
    assert torch.equal(source.mean_map[source.index], torch.eye(observations, dtype=torch.float64))


@pytest.mark.parametrize("T", LENGTHS)
@pytest.mark.parametrize("index", [(), ENDPOINTS])
def test_every_length_scale_and_horizon_factors(T: int, index: tuple[int, ...]) -> None:
    for length_scale in LENGTH_SCALES:
        assert_factored(Source(rbf(T, length_scale, 1.0, 1e-6), index))


@pytest.mark.parametrize("kind", ["gp", "cgp"])
def test_the_corners_of_what_the_config_allows_factor(kind: str) -> None:
    corners = itertools.product((1e-6, 1e6), (1e-6, 1e6), (1e-12, 1e6), (3, 32, 65))
    for length_scale, sigma_f, epsilon, T in corners:
        settings = Settings(kind, length_scale, sigma_f, epsilon, None, False)  # type: ignore[arg-type]
        assert_factored(build_source(settings, T))


@pytest.mark.parametrize("T", [3, 32, 512])
@pytest.mark.parametrize("length_scale", [0.01, 0.4, 10.0])
def test_via_points_side_by_side_factor(T: int, length_scale: float) -> None:
    """Neighbours tell each other almost everything; epsilon alone keeps them apart."""
    middle = range(T // 2 - 1, min(T // 2 + 3, T - 1))
    assert_factored(Source(rbf(T, length_scale, 1.0, 1e-6), sorted({0, *middle, T - 1})))


def test_observations_that_cannot_differ_are_refused_with_the_reason() -> None:
    """Without epsilon, waypoints of a process this stiff are the same number."""
    K = rbf(32, 1e9, 1.0, 0.0)
    with pytest.raises(ValueError, match=r"^conditioned waypoints \[0, 1, -1\]: expected a covariance that tells them"):
        Source(K, (0, 1, -1))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


DEGENERATE = {
    "still at zero": torch.zeros(20, 16, 4),
    "still elsewhere": torch.full((20, 16, 4), 0.7),
    "one straight line": torch.linspace(-1, 1, 16)[None, :, None].expand(1, 16, 4),
    "white noise": torch.randn(50, 16, 4, generator=generator()),
    "too small for float32": 1e-30 * torch.randn(20, 16, 4, generator=generator()),
    "jumping to and fro": (torch.arange(16) % 2 * 2.0 - 1)[None, :, None].expand(10, 16, 4),
    "three waypoints": torch.randn(20, 3, 4, generator=generator()),
}


@pytest.mark.parametrize("index", [(), ENDPOINTS])
@pytest.mark.parametrize("what", DEGENERATE)
def test_a_fit_to_demonstrations_without_a_maximum_is_a_source_that_factors(what: str, index: tuple[int, ...]) -> None:
    x: Tensor = DEGENERATE[what]
    length_scale, sigma_f = fit_rbf(x, index)
    assert 1e-6 <= length_scale <= 10
    assert 1e-6 <= sigma_f <= 1e6
    assert_factored(Source(rbf(x.shape[1], length_scale, sigma_f, 1e-6), index))


@pytest.mark.parametrize(
    ("x", "index", "said"),
    [
        (torch.zeros(0, 32, 4), (), r"demonstrations of shape \(0, 32, 4\): expected some"),
        (
            torch.zeros(9, 2, 4),
            ENDPOINTS,
            r"demonstrations of shape \(9, 2, 4\): .* a waypoint that is not conditioned",
        ),
    ],
)
def test_what_has_nothing_to_fit_is_refused(x: Tensor, index: tuple[int, ...], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        fit_rbf(x, index)


def test_a_fit_without_enough_epsilon_says_so() -> None:
    """Of straight lines the likelihood wants the stiffest kernel, which needs epsilon to be factored."""
    x = swap(50, amplitudes=())
    with pytest.raises(
        ValueError, match=r"^epsilon=1e-16: expected a larger one, with which length_scale=.* can be factored"
    ):
        fit_rbf(x, ENDPOINTS, epsilon=1e-16)
