"""The smoothed correction u^c against SciPy's Gaussian filter."""

import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from conflow.flow.correction import Correction, gaussian_filter
from conflow.scene.constraint import RobotAvoidance
from conflow.scene.robots import PointRobots


class Quadratic:
    """C(x) = |x|^2 / 2, whose gradient is x."""

    def gradient(self, x: Tensor) -> Tensor:
        return x


widths = pytest.mark.parametrize(("T", "sigma", "width"), [(32, 5.0, 9), (32, 0.7, 4), (5, 2.0, 3), (3, 5.0, 9)])


@widths
def test_the_filter_is_scipys(T: int, sigma: float, width: int) -> None:
    """S g is gaussian_filter1d of g with zeros beyond the ends, `width` taps or, if even, one fewer."""
    g = torch.randn(T, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = gaussian_filter1d(g.numpy(), sigma, axis=0, mode="constant", radius=(width - 1) // 2)
    # float64 rounding
    torch.testing.assert_close(gaussian_filter(T, sigma, width) @ g, torch.from_numpy(expected), rtol=0, atol=1e-14)


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


@pytest.mark.parametrize("constraint", [Quadratic(), RobotAvoidance(PointRobots(2))], ids=["quadratic", "robots"])
def test_the_correction_filters_every_dimension_by_itself(constraint: Quadratic | RobotAvoidance) -> None:
    """u^c is the constraint's gradient, filtered along the trajectory in each trajectory and dimension."""
    x = 0.3 * torch.randn(3, 32, 4, generator=torch.Generator().manual_seed(0))
    expected = gaussian_filter1d(constraint.gradient(x).double().numpy(), 5.0, axis=1, mode="constant", radius=4)
    u_c = Correction(constraint, gaussian_filter(32))(x)
    # The product is in float32: nine terms of order 1.
    torch.testing.assert_close(u_c.double(), torch.from_numpy(expected), rtol=0, atol=1e-6)


def test_a_checkpoint_holds_nothing_of_the_correction() -> None:
    """The correction follows from the config: its state is empty, so another one fits the same checkpoint."""
    assert not Correction(RobotAvoidance(PointRobots(2)), gaussian_filter(32)).state_dict()
