"""Sampling the ODE dx/dt = v(x, t) from t = 0 to 1, and guidance as a field that wraps one (paper: "Inference")."""

from collections import deque
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from conflow.flow.path import end
from conflow.flow.settings import Solver

Field = Callable[[Tensor, Tensor], Tensor]
"""A velocity field: x (batch, T, D) and t (batch,) to dx/dt (batch, T, D)."""

PIECE = 2048
"""Trajectories that a network sees at a time, the same on every machine: a matrix product's bits vary with its size."""
NUMBERS = 4 * PIECE
"""Rows times numbers of a configuration in a piece at most: what pairs of robots need grows with its square."""

Push = Callable[[Tensor], Tensor]
"""lambda u^c: where a trajectory x (batch, T, D) should move, with its weight; of several constraints the sum."""


def guided(v: Field, push: Push) -> Field:
    """v(x, t) + lambda u^c(x): the field v, guided where the flow is."""

    def field(x: Tensor, t: Tensor) -> Tensor:
        return v(x, t) + push(x)

    return field


def guided_ahead(v: Field, push: Push) -> Field:
    """v(x, t) + lambda t u^c(x + (1 - t) v(x, t)): guided where the flow is going to end instead of where it is.

    What is in collision halfway may be none at t = 1, and needs no guidance. The factor t: the end that is predicted
    at t = 0 is the mean of all that x_0 may become, which lies between the ways around an obstacle.
    """

    def field(x: Tensor, t: Tensor) -> Tensor:
        u = v(x, t)
        return u + t[:, None, None] * push(end(x, u, t))

    return field


def descended(v: Field, push: Push, steps: int, since: float = 0.3) -> Field:
    """(e - x) / (1 - t): towards the predicted end e = x + (1 - t) v(x, t) after steps e <- e + lambda u^c(e).

    The steps are of covariant gradient descent on the barrier, with lambda as their length: what is wrong with the end
    is put right there, whatever time is left. A push of the velocity, which t = 1 cuts short, would have to be the
    stronger the less time is left, and an explicit solver could not carry it. Before t = `since` the predicted end is
    the mean of too much, and nothing is done.
    """

    def field(x: Tensor, t: Tensor) -> Tensor:
        u = v(x, t)
        # An accelerator would wait for a number that is read.
        if t.device.type == "cpu" and bool((t < since).all()):
            return u
        e = predicted = end(x, u, t)
        for _ in range(steps):
            e = e + push(e)
        left = torch.where((t < since) | (t >= 1), torch.inf, 1 - t)
        return u + (e - predicted) / left[:, None, None]

    return field


def euler(v: Field, x: Tensor, t: Tensor, h: float) -> Tensor:
    """One step of order 1, one evaluation."""
    return x + h * v(x, t)


def midpoint(v: Field, x: Tensor, t: Tensor, h: float) -> Tensor:
    """One step of order 2, two evaluations."""
    return x + h * v(x + h / 2 * v(x, t), t + h / 2)


def rk4(v: Field, x: Tensor, t: Tensor, h: float) -> Tensor:
    """One step of order 4 (the classical Runge-Kutta method), four evaluations."""
    k_1 = v(x, t)
    k_2 = v(x + h / 2 * k_1, t + h / 2)
    k_3 = v(x + h / 2 * k_2, t + h / 2)
    k_4 = v(x + h * k_3, t + h)
    return x + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4)


STEPS: dict[Solver, Callable[[Field, Tensor, Tensor, float], Tensor]] = {
    "euler": euler,
    "midpoint": midpoint,
    "rk4": rk4,
}


@torch.no_grad()
def states(v: Field, x_0: Tensor, steps: int = 250, solver: Solver = "euler") -> Iterator[Tensor]:
    """The states x_t at t = 0, 1/steps, ..., 1 of the ODE that starts at x_0, `steps` + 1 times (batch, T, D)."""
    x = x_0
    yield x
    for k in range(steps):
        # k / steps rather than a running sum: the last step ends at t = 1 exactly.
        x = STEPS[solver](v, x, torch.full_like(x[:, 0, 0], k / steps), 1 / steps)
        yield x


def integrate(v: Field, x_0: Tensor, steps: int = 250, solver: Solver = "euler") -> Tensor:
    """x_1: where the ODE that starts at x_0 (batch, T, D) arrives at t = 1.

    >>> v = lambda x, t: x  # dx/dt = x ends at e = 2.71828...
    >>> [round(integrate(v, torch.ones(1, 1, 1), 10, solver).item(), 3) for solver in ("euler", "midpoint", "rk4")]
    [2.594, 2.714, 2.718]
    """
    return deque(states(v, x_0, steps, solver), maxlen=1).pop()


def in_pieces(f: Callable[..., Tensor], *batches: Tensor) -> Tensor:
    """f(*batches), row by row a function of its arguments (batch, ..., D): PIECE rows at a time, or fewer of large D.

    What f needs beside its result, such as a network's activations, does not grow with the batch then.
    """
    rows = min(PIECE, max(1, NUMBERS // batches[0].shape[-1]))
    return torch.cat([f(*piece) for piece in zip(*(batch.split(rows) for batch in batches), strict=True)])
