"""The conditional path x_t and its velocity u_t."""

import pytest
import torch

from conflow.flow.path import interpolate, velocity


def ends(batch: int, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    x_0, x_1 = torch.randn(2, batch, 7, 3, dtype=dtype, generator=generator)
    return x_0, x_1


def test_the_path_is_the_affine_combination() -> None:
    """x_t = (1 - t) x_0 + t x_1, each trajectory at its own t."""
    x_0, x_1 = ends(3, torch.float64)
    t = torch.tensor([0.1, 0.5, 0.8], dtype=torch.float64)
    x_t = interpolate(x_0, x_1, t)
    for b in range(3):
        expected = (1 - t[b]) * x_0[b] + t[b] * x_1[b]
        torch.testing.assert_close(x_t[b], expected, rtol=0, atol=1e-15)  # float64 rounding


@pytest.mark.parametrize("batch", [1, 5, 1000])
def test_the_path_meets_both_ends_to_the_last_bit(batch: int) -> None:
    """x_t is x_0 at t = 0 and x_1 at t = 1, also where the two differ by orders of magnitude."""
    x_0, x_1 = ends(batch)
    x_1 = 1e-4 * x_1
    assert torch.equal(interpolate(x_0, x_1, torch.zeros(batch)), x_0)
    assert torch.equal(interpolate(x_0, x_1, torch.ones(batch)), x_1)


def test_shared_waypoints_do_not_move() -> None:
    """Where x_0 and x_1 agree, x_t equals them to the last bit for every t."""
    x_0, x_1 = ends(1000)
    x_1[:, [0, -1]] = x_0[:, [0, -1]]
    x_t = interpolate(x_0, x_1, torch.rand(1000, generator=torch.Generator().manual_seed(1)))
    assert torch.equal(x_t[:, [0, -1]], x_0[:, [0, -1]])
    assert not bool((x_t[:, 1:-1] == x_0[:, 1:-1]).all(dim=(1, 2)).any())


def test_the_velocity_is_the_paths_derivative() -> None:
    """u_t = d x_t / dt by central differences, at any t."""
    x_0, x_1 = ends(5, torch.float64)
    t, h = torch.rand(5, dtype=torch.float64, generator=torch.Generator().manual_seed(1)), 0.01
    derivative = (interpolate(x_0, x_1, t + h) - interpolate(x_0, x_1, t - h)) / (2 * h)
    # The path is affine, so only float64's rounding remains, divided by h.
    torch.testing.assert_close(velocity(x_0, x_1), derivative, rtol=0, atol=1e-13)
