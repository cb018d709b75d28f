"""What a user would take instead: other libraries, each of them optional."""

from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import TypeVar

import torch
from torch import Tensor

PEERS = {
    "torchcfm": "torchcfm",
    "flow_matching": "flow_matching",
    "torchdiffeq": "torchdiffeq",
    "gpytorch": "gpytorch",
    "scikit-learn": "sklearn",
}
"""Each peer's distribution and the module that it is imported as."""

Field = Callable[[Tensor, Tensor], Tensor]
StraightPath = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""x_t and u_t (batch, T, D) from x_0, x_1 (batch, T, D) and t (batch,)."""
Made = TypeVar("Made")
Solve = Callable[[Field, Tensor, int, str], Tensor]
"""x_1 from a velocity field, x_0 (batch, T, D), a number of steps and the name of a method."""


def versions() -> dict[str, str]:
    """The version of each peer, "absent" where it is not installed."""
    found = {}
    for name, module in PEERS.items():
        try:
            found[name] = version(name) if find_spec(module) else "absent"
        except PackageNotFoundError:
            found[name] = "absent"
    return found


def paths() -> Mapping[str, StraightPath | None]:
    """The straight path of each peer that has one; None where it is absent."""
    return {"torchcfm": _made(_torchcfm), "flow_matching": _made(_flow_matching_path)}


def solvers() -> Mapping[str, Solve | None]:
    """The ODE solver of each peer that has one; None where it is absent."""
    return {"torchdiffeq": _made(_torchdiffeq), "flow_matching": _made(_flow_matching_solver)}


def processes() -> Mapping[str, "Callable[[Tensor, Tensor], Callable[[], object]] | None"]:
    """Samplers of an RBF process conditioned on start and goal, by peer; None where it is absent."""
    return {"gpytorch": _made(_gpytorch), "scikit-learn": _made(_sklearn)}


def _made(make: Callable[[], Made]) -> Made | None:
    try:
        return make()
    except ImportError:
        return None


def _torchcfm() -> StraightPath:
    from torchcfm import ConditionalFlowMatcher

    matcher = ConditionalFlowMatcher(sigma=0.0)

    def path(x_0: Tensor, x_1: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        _, x_t, u_t = matcher.sample_location_and_conditional_flow(x_0, x_1, t=t)
        return x_t, u_t

    return path


def _flow_matching_path() -> StraightPath:
    from flow_matching.path import CondOTProbPath

    straight = CondOTProbPath()

    def path(x_0: Tensor, x_1: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        sample = straight.sample(t=t, x_0=x_0, x_1=x_1)
        return sample.x_t, sample.dx_t

    return path


def _torchdiffeq() -> Solve:
    from torchdiffeq import odeint

    def solve(v: Field, x_0: Tensor, steps: int, method: str) -> Tensor:
        def f(t: Tensor, x: Tensor) -> Tensor:
            return v(x, t.expand(len(x)))

        times = torch.tensor([0.0, 1.0], device=x_0.device)
        with torch.no_grad():
            states: Tensor = odeint(f, x_0, times, method=method, options={"step_size": 1 / steps})
        return states[-1]

    return solve


def _flow_matching_solver() -> Solve:
    from flow_matching.solver import ODESolver

    def solve(v: Field, x_0: Tensor, steps: int, method: str) -> Tensor:
        solver = ODESolver(velocity_model=lambda x, t: v(x, t.expand(len(x))))
        x_1: Tensor = solver.sample(x_init=x_0, step_size=1 / steps, method=method)
        return x_1

    return solve


def _gpytorch() -> Callable[[Tensor, Tensor], Callable[[], object]]:
    import gpytorch
    from gpytorch.distributions import MultivariateNormal
    from gpytorch.likelihoods import FixedNoiseGaussianLikelihood

    class Process(gpytorch.models.ExactGP):  # type: ignore[misc]  # a library without types
        def __init__(self, s: Tensor, y: Tensor, likelihood: FixedNoiseGaussianLikelihood) -> None:
            super().__init__(s, y, likelihood)
            self.mean = gpytorch.means.ZeroMean()
            self.covariance = gpytorch.kernels.RBFKernel()
            self.covariance.lengthscale = 0.4

        def forward(self, s: Tensor) -> MultivariateNormal:
            return MultivariateNormal(self.mean(s), self.covariance(s))

    def sampler(s: Tensor, y: Tensor) -> Callable[[], object]:
        # A batch of processes, one for each trajectory and dimension.
        values = y.mT
        ends, places = (where[:, None].expand(*values.shape[:2], -1, 1) for where in (s[[0, -1]], s))
        likelihood = FixedNoiseGaussianLikelihood(torch.full_like(values, 1e-4))

        def sample() -> Tensor:
            process = Process(ends, values, likelihood).eval()
            with torch.no_grad():
                drawn: Tensor = process(places).rsample()
            return drawn

        return sample

    return sampler


def _sklearn() -> Callable[[Tensor, Tensor], Callable[[], object]]:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF

    def sampler(s: Tensor, y: Tensor) -> Callable[[], object]:
        places, ends = s.numpy()[:, None], s[[0, -1]].numpy()[:, None]
        values = y.movedim(1, 0).flatten(1).numpy()  # one target for each trajectory and dimension

        def sample() -> object:
            process = GaussianProcessRegressor(RBF(0.4), alpha=1e-6, optimizer=None).fit(ends, values)
            return process.sample_y(places, random_state=0)

        return sample

    return sampler
