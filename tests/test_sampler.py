"""Integration of the field against closed forms and torchdiffeq, and guidance without autograd."""

import math
from collections.abc import Callable
from typing import Any, NoReturn, get_args

import pytest
import torch
from torch import Tensor
from torchdiffeq import odeint

from conflow.flow.correction import Correction, gaussian_filter
from conflow.flow.network import ResMLP
from conflow.flow.path import end
from conflow.flow.sampler import Field, descended, guided, guided_ahead, integrate, states
from conflow.flow.settings import Solver
from tests.papers import keep_apart

SOLVERS: tuple[Solver, ...] = get_args(Solver)

solvers = pytest.mark.parametrize("solver", SOLVERS)


def initial(dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(3, 8, 4, dtype=dtype, generator=torch.Generator().manual_seed(0)) + 0.5


def bernoulli(x: Tensor, t: Tensor) -> Tensor:
    """dx/dt = -2 t x^2 + x, nonlinear and dependent on t."""
    return -2 * t[:, None, None] * x**2 + x


def bernoullis_solution(x_0: Tensor) -> Tensor:
    """x(1) for that field: 1/x = (1/x_0 + 2) e^-t + 2 (t - 1), so at t = 1 it is (1/x_0 + 2) / e."""
    return math.e / (1 / x_0 + 2)


def linear(x: Tensor, t: Tensor) -> Tensor:
    """dx/dt = A x + b, a rotation with drift; b is the same for every t."""
    return x.roll(1, dims=2) - 0.5 * x + 1


@pytest.mark.parametrize(("solver", "order"), [("euler", 1), ("midpoint", 2), ("rk4", 4)])
def test_the_error_falls_with_the_solvers_order(solver: Solver, order: int) -> None:
    """Against the closed form, the error of n steps is proportional to n^-1, n^-2 and n^-4."""
    steps = torch.tensor([20.0, 40, 80, 160])
    exact = bernoullis_solution(initial())
    error = torch.tensor([float((integrate(bernoulli, initial(), int(n), solver) - exact).abs().max()) for n in steps])
    slope = torch.log(error[:-1] / error[1:]) / math.log(2)
    # The next term of the error changes the slope by O(1/n).
    torch.testing.assert_close(slope, torch.full((3,), float(order)), rtol=0, atol=0.15)


@pytest.mark.parametrize(
    ("solver", "field"),
    # torchdiffeq's rk4 is the 3/8 rule: both are the same polynomial of h A where the field is linear in x.
    [("euler", bernoulli), ("midpoint", bernoulli), ("rk4", linear)],
)
def test_fixed_steps_are_torchdiffeqs(solver: Solver, field: Field) -> None:
    """As many steps of the same method arrive at the same place."""
    x_0, steps = initial(), 20

    def dx_dt(t: Tensor, x: Tensor) -> Tensor:
        return field(x, t.expand(len(x)))

    time = torch.tensor([0.0, 1.0], dtype=torch.float64)
    expected = odeint(dx_dt, x_0, time, method=solver, options={"step_size": 1 / steps})[-1]
    torch.testing.assert_close(integrate(field, x_0, steps, solver), expected, rtol=0, atol=1e-13)  # float64 rounding


@solvers
@pytest.mark.parametrize("steps", [1, 3, 7, 49, 250])
def test_the_field_is_asked_inside_the_unit_interval(solver: Solver, steps: int) -> None:
    """In float32 step k begins at k/steps; the last one of rk4 ends at exactly 1; nothing is asked beyond."""
    asked: list[Tensor] = []

    def field(x: Tensor, t: Tensor) -> Tensor:
        asked.append(t)
        return x

    integrate(field, initial(torch.float32), steps, solver)
    evaluations = {"euler": 1, "midpoint": 2, "rk4": 4}[solver]
    times = torch.stack(asked)
    assert times.shape == (evaluations * steps, 3)
    assert torch.equal(times, times[:, :1].expand_as(times))
    assert torch.equal(times[::evaluations, 0], torch.tensor([k / steps for k in range(steps)]))
    assert 0 <= times.min() <= times.max() <= 1
    if solver == "rk4":
        assert times[-1, 0] == 1


@solvers
def test_the_states_lead_from_x_0_to_what_integrate_returns(solver: Solver) -> None:
    """steps + 1 states: x_0 first, x_1 last, and each one step from the one before."""
    path = list(states(bernoulli, initial(), 5, solver))
    assert len(path) == 6
    assert torch.equal(path[0], initial())
    assert torch.equal(path[-1], integrate(bernoulli, initial(), 5, solver))
    shifted = list(states(lambda x, t: bernoulli(x, t + 0.2), path[1], 5, solver))
    torch.testing.assert_close(shifted[1], path[2], rtol=0, atol=1e-15)  # float64 rounding


@solvers
def test_sampling_leaves_its_start_alone(solver: Solver) -> None:
    """x_0 is not changed in place."""
    x_0 = initial()
    integrate(bernoulli, x_0, 3, solver)
    assert torch.equal(x_0, initial())


def test_guidance_adds_the_weighted_correction() -> None:
    """guided(v, lambda u) is v + lambda u, and v itself for weight 0."""
    x, t = initial(), torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    torch.testing.assert_close(guided(bernoulli, weighted(0.7))(x, t), bernoulli(x, t) + 0.7 * torch.sin(x))
    assert torch.equal(guided(bernoulli, weighted(0.0))(x, t), bernoulli(x, t))


def weighted(weight: float) -> Callable[[Tensor], Tensor]:
    """lambda sin(x) as a push."""
    return lambda x: weight * torch.sin(x)


def test_guidance_ahead_pushes_at_the_predicted_end() -> None:
    x, t = initial(), torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    v, s = bernoulli(x, t), t[:, None, None]
    torch.testing.assert_close(guided_ahead(bernoulli, weighted(0.7))(x, t), v + s * 0.7 * torch.sin(x + (1 - s) * v))


@pytest.mark.parametrize("t", [0.3, 0.5, 0.99])
def test_descent_leads_straight_to_the_descended_end(t: float) -> None:
    """Whoever follows the field of one moment to t = 1 arrives at e after the steps of descent."""
    x, now = initial(), torch.full((3,), t, dtype=torch.float64)
    e = end(x, bernoulli(x, now), now)
    for _ in range(3):
        e = e + 0.7 * torch.sin(e)
    torch.testing.assert_close(end(x, descended(bernoulli, weighted(0.7), steps=3)(x, now), now), e)


@pytest.mark.parametrize("t", [0.0, 0.29, 1.0])
def test_descent_leaves_the_field_alone_where_there_is_nothing_to_predict(t: float) -> None:
    """Early on the end is the mean of too much; at t = 1 no time is left, and rk4 asks for the field there."""
    x, now = initial(), torch.full((3,), t, dtype=torch.float64)
    assert torch.equal(descended(bernoulli, weighted(0.7), steps=4)(x, now), bernoulli(x, now))


@pytest.mark.parametrize("steps", [10, 250])
def test_one_euler_step_from_the_end_descent_puts_right_what_a_push_cannot(steps: int) -> None:
    """A flow straight to x_1 = 0, where x_1 >= 1 is asked for: descent keeps it, with few steps and with many.

    A push lambda (1 - x)_+ per unit of time ends at (1 - 0) lambda / (1 + lambda) of the way or worse.
    """

    def towards_zero(x: Tensor, t: Tensor) -> Tensor:
        return -x / (1 - t[:, None, None])

    def short(x: Tensor) -> Tensor:
        return 0.5 * (1 - x).clamp_min(0)

    x_0 = initial()
    # Each of four half steps leaves half of what is missing.
    assert bool((integrate(descended(towards_zero, short, steps=4), x_0, steps) >= 1 - 2**-4 - 1e-9).all())
    assert bool((integrate(guided(towards_zero, short), x_0, steps) < 0.5).all())


@solvers
def test_sampling_needs_no_autograd(solver: Solver, monkeypatch: pytest.MonkeyPatch) -> None:
    """A trainable network, guided by a constraint, is sampled without a derivative and without a graph."""

    def refuse(*_: Any, **__: Any) -> NoReturn:
        raise AssertionError("autograd was called")

    monkeypatch.setattr(torch.autograd, "grad", refuse)
    monkeypatch.setattr(torch.autograd, "backward", refuse)
    monkeypatch.setattr(Tensor, "backward", refuse)
    torch.manual_seed(0)
    v = ResMLP(8, 4, hidden=16, blocks=1)
    correction = Correction(keep_apart(2), gaussian_filter(8))
    x_0 = initial(torch.float32)
    free, pushed = integrate(v, x_0, 5, solver), integrate(guided(v, correction), x_0, 5, solver)
    assert not pushed.requires_grad
    assert not torch.equal(pushed, free)
    with torch.inference_mode():
        assert torch.equal(integrate(guided(v, correction), x_0, 5, solver), pushed)
    assert torch.is_grad_enabled()


def test_gradients_are_still_recorded_between_two_states() -> None:
    """`states` turns autograd off only while it steps: its caller may train on what it yields."""
    weight = torch.ones((), dtype=torch.float64, requires_grad=True)
    for x in states(lambda x, t: weight * x, initial(), 2):
        assert not x.requires_grad
        assert (weight * x).requires_grad
