"""The smoothed correction u^c: the Gaussian filter against SciPy's, the covariant one, and repair by it."""

from itertools import islice
from typing import get_args

import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from conflow.flow import source
from conflow.flow.correction import Correction, covariant, descend, descent, gaussian_filter
from conflow.flow.settings import Edges
from conflow.scene.constraint import Barrier, Constraint
from conflow.scene.settings import BarrierShape
from conflow.scene.tasks.swap import swap
from tests.papers import keep_apart


class Quadratic:
    """C(x) = |x|^2 / 2, whose gradient is x."""

    def clearance(self, x: Tensor) -> Tensor:
        return x.amin(dim=2)

    def barrier(self, x: Tensor) -> Tensor:
        return x.square().sum(dim=(1, 2)) / 2

    def gradient(self, x: Tensor) -> Tensor:
        return x

    def clearance_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.clearance(x), self.gradient(x)

    def barrier_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.barrier(x), self.gradient(x)


widths = pytest.mark.parametrize(("T", "sigma", "width"), [(32, 5.0, 9), (32, 0.7, 4), (5, 2.0, 3), (3, 5.0, 9)])


@widths
@pytest.mark.parametrize("edges", get_args(Edges))
def test_the_filter_is_scipys(T: int, sigma: float, width: int, edges: Edges) -> None:
    """S g is gaussian_filter1d of g, `width` taps or, if even, one fewer; normalised: divided by that of ones."""
    g = torch.randn(T, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    mode = "nearest" if edges == "nearest" else "constant"
    expected, ones = (
        gaussian_filter1d(values.numpy(), sigma, axis=0, mode=mode, radius=(width - 1) // 2)
        for values in (g, torch.ones_like(g))
    )
    found = gaussian_filter(T, sigma, width, edges) @ g
    # float64 rounding
    torch.testing.assert_close(
        found, torch.from_numpy(expected / ones if edges == "normalised" else expected), rtol=0, atol=1e-14
    )


@widths
def test_the_filter_is_symmetric(T: int, sigma: float, width: int) -> None:
    """S = S^T: a waypoint gives to its neighbour what it gets from it."""
    S = gaussian_filter(T, sigma, width)
    assert torch.equal(S, S.mT)


def test_a_filter_of_width_one_changes_nothing() -> None:
    """One tap is the identity."""
    assert torch.equal(gaussian_filter(7, sigma=5.0, width=1), torch.eye(7, dtype=torch.float64))


def test_the_filter_keeps_constants_inside_and_loses_them_at_the_ends() -> None:
    """Rows sum to 1 where all nine taps fit, and to less where some fall beyond the ends."""
    rows = gaussian_filter(32).sum(dim=1)
    torch.testing.assert_close(rows[4:-4], torch.ones_like(rows[4:-4]), rtol=0, atol=1e-14)  # float64 rounding
    assert bool((rows[:4] < 0.95).all())
    assert bool((rows[-4:] < 0.95).all())


@pytest.mark.parametrize("constraint", [Quadratic(), keep_apart(2)], ids=["quadratic", "robots"])
def test_the_correction_filters_every_dimension_by_itself(constraint: Quadratic | Constraint) -> None:
    """u^c is the constraint's gradient, filtered along the trajectory in each trajectory and dimension."""
    x = 0.3 * torch.randn(3, 32, 4, generator=torch.Generator().manual_seed(0))
    expected = gaussian_filter1d(constraint.gradient(x).double().numpy(), 5.0, axis=1, mode="constant", radius=4)
    u_c = Correction(constraint, gaussian_filter(32))(x)
    # The product is in float32: nine terms of order 1.
    torch.testing.assert_close(u_c.double(), torch.from_numpy(expected), rtol=0, atol=1e-6)


def test_a_checkpoint_holds_nothing_of_the_correction() -> None:
    """The correction follows from the config: its state is empty, so another one fits the same checkpoint."""
    assert not Correction(keep_apart(2), gaussian_filter(32)).state_dict()


def robots(margin: float = 0.0, shape: Barrier | None = None) -> Constraint:
    return keep_apart(2, 0.3 + margin, shape)


def colliding(num: int, T: int = 32) -> Tensor:
    x = swap(num, T)
    return x[robots().violation(x)]


def test_the_covariant_correction_leaves_what_the_source_is_conditioned_on() -> None:
    """Rows of Sigma at start and goal are zero, so u^c is zero there to the last bit; the filter's is not."""
    x = colliding(300)
    x[:, 1] = x[:, 0]
    x[:, 1, 2:] = x[:, 1, :2] + 0.1  # a collision beside the start
    moved, kept = (Correction(robots(), S)(x)[:, [0, -1]] for S in (gaussian_filter(32), covariant(cgp().covariance)))
    assert not kept.any()
    assert moved.any()


def cgp(T: int = 32, length_scale: float = 0.4) -> source.Source:
    return source.cgp(T, length_scale)


def test_a_covariant_correction_is_a_shift_of_finite_cameron_martin_norm() -> None:
    """|Sigma g|^2 in the norm of Sigma^-1 is <g, Sigma g>: moderate, where the filtered bump's is astronomical."""
    Sigma = cgp().covariance[1:-1, 1:-1]
    g = robots().gradient(colliding(300)).double()[:, 1:-1]
    norms = []
    for S in (covariant(Sigma), gaussian_filter(32)[1:-1, 1:-1]):
        u_c = S @ g
        norms.append(((u_c * torch.linalg.solve(Sigma, u_c)).sum(dim=(1, 2)) / u_c.square().sum(dim=(1, 2))).median())
    # Per unit of displacement: a few inverse variances of the leading modes, against that of the white part, 1e6.
    assert norms[0] < 10
    assert norms[1] > 1e3


@pytest.mark.parametrize(("T", "length_scale"), [(16, 0.4), (64, 0.4), (128, 0.4), (32, 0.2), (32, 0.8), (32, 1.6)])
def test_lambda_means_the_same_for_every_number_of_waypoints_and_length_scale(T: int, length_scale: float) -> None:
    """The time in which x' = u^c(x) takes 90 % of D- out of collision, against T = 32 and length scale 0.4."""

    def clearing_time(T: int, length_scale: float) -> float:
        x, tau = colliding(300, T), 0.0
        u_c = Correction(robots(), covariant(cgp(T, length_scale).covariance))
        while robots().violation(x).float().mean() > 0.1:
            x, tau = x + 0.02 * u_c(x), tau + 0.02
        return tau

    # Within 15 %; the covariance itself, or scaled to a peak of 1, is off by factors from 2 to 100.
    assert clearing_time(T, length_scale) == pytest.approx(clearing_time(32, 0.4), rel=0.15)


@pytest.mark.parametrize(("shape", "momentum"), [("relu", 0.0), ("square", 0.7)])
def test_descent_moves_every_collision_out_and_nothing_else(shape: BarrierShape, momentum: float) -> None:
    """The gradient flow of the covariant correction, with start and goal fixed to the last bit."""
    x = swap(2000)
    u_c = Correction(robots(0.06, Barrier(shape)), covariant(cgp().covariance))
    again = descend(x, u_c, 100, momentum)
    assert not robots(0.058).violation(again).any()
    assert torch.equal(again[:, [0, -1]], x[:, [0, -1]])
    untouched = ~robots(0.06).violation(x)
    assert torch.equal(again[untouched], x[untouched])
    # A displacement of centimetres, not another trajectory.
    assert (again - x)[~untouched].abs().amax(dim=(1, 2)).median() < 0.25


def test_the_states_of_descent_begin_with_what_is_given_and_end_where_it_arrives() -> None:
    x, u_c = swap(20), Correction(robots(0.06, Barrier("square")), covariant(cgp().covariance))
    states = list(islice(descent(x, u_c, 0.7), 6))
    assert torch.equal(states[0], x)
    assert torch.equal(states[5], descend(x, u_c, 5, 0.7))
    assert torch.equal(descend(x, u_c, 0, 0.7), x)


def test_one_step_of_descent_solves_a_linear_constraint() -> None:
    """C = <n, x> - b where negative: one Newton step lands on C = 0, moved along S n."""
    n = torch.randn(5, 2, generator=torch.Generator().manual_seed(0))

    class Halfspace(Quadratic):
        def barrier(self, x: Tensor) -> Tensor:
            return ((n * x).sum(dim=(1, 2)) - 1).clamp(max=0)

        def gradient(self, x: Tensor) -> Tensor:
            return n.expand_as(x)

    S = gaussian_filter(5, 2.0, 3)
    x = torch.zeros(1, 5, 2)
    moved = descend(x, Correction(Halfspace(), S), steps=1)
    assert (n * moved).sum().item() == pytest.approx(1, abs=1e-6)
    torch.testing.assert_close(moved[0] / moved.norm(), (S.float() @ n) / (S.float() @ n).norm())


def test_what_cannot_be_repaired_stays_as_it_is() -> None:
    """Two robots on one path have no direction in which to part."""
    x = torch.linspace(-0.5, 0.5, 32)[None, :, None].expand(1, 32, 4).contiguous()
    assert torch.equal(descend(x, Correction(robots(0.06, Barrier("relu")), covariant(cgp().covariance)), 100), x)
