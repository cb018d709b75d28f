"""The conditional path x_t and its velocity u_t, straight and guided."""

import pytest
import torch
from scipy.integrate import solve_ivp

from conflow.flow.path import end, guided_path, interpolate, velocity


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


def test_the_end_of_the_straight_path_is_the_demonstration() -> None:
    """x_t + (1 - t) (x_1 - x_0) = x_1 from every t."""
    x_0, x_1 = ends(100, torch.float64)
    t = torch.rand(100, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    reached = end(interpolate(x_0, x_1, t), velocity(x_0, x_1), t)
    torch.testing.assert_close(reached, x_1, rtol=0, atol=1e-14)  # float64 rounding


def test_a_guided_path_without_weight_is_the_straight_one() -> None:
    x_0, x_1 = ends(50, torch.float64)
    t = torch.rand(50, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    x_t, u_t = guided_path(x_0, x_1, t, torch.sin, torch.zeros(50, dtype=torch.float64))
    torch.testing.assert_close(x_t, interpolate(x_0, x_1, t), rtol=0, atol=1e-14)  # float64 rounding
    assert torch.equal(u_t, velocity(x_0, x_1))


def test_a_guided_path_solves_its_equation() -> None:
    """Against SciPy's DOP853 on x' = (x_1 - x_0) + w sin(x), each trajectory with its own weight w and time t."""
    x_0, x_1 = ends(3, torch.float64)
    t = torch.tensor([0.2, 0.7, 1.0], dtype=torch.float64)
    w = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    x_t, u_t = guided_path(x_0, x_1, t, torch.sin, w, steps=64)
    for b in range(3):
        slope = velocity(x_0, x_1)[b].flatten().numpy()
        weight = float(w[b])

        def rhs(_: float, x: object, slope: object = slope, weight: float = weight) -> torch.Tensor:
            return torch.as_tensor(slope) + weight * torch.sin(torch.as_tensor(x))

        solution = solve_ivp(rhs, (0, float(t[b])), x_0[b].flatten().numpy(), method="DOP853", rtol=1e-10, atol=1e-12)
        # The midpoint rule's error at 64 steps: (1/64)^2 times a third derivative of some 10.
        torch.testing.assert_close(x_t[b].flatten(), torch.from_numpy(solution.y[:, -1]), rtol=0, atol=2e-3)
    torch.testing.assert_close(u_t, velocity(x_0, x_1) + w[:, None, None] * torch.sin(x_t))


def test_the_guided_paths_error_falls_with_the_square_of_its_steps() -> None:
    """The midpoint rule is of order 2."""
    x_0, x_1 = ends(200, torch.float64)
    t, w = torch.ones(200, dtype=torch.float64), torch.full((200,), 1.5, dtype=torch.float64)
    exact, _ = guided_path(x_0, x_1, t, torch.sin, w, steps=512)
    errors = [(guided_path(x_0, x_1, t, torch.sin, w, steps)[0] - exact).abs().mean().item() for steps in (8, 16)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.2)
