"""Source distributions p_0 over trajectories (paper: "Constraint-Injected Source Distribution").

Every source is a Gaussian process on the T waypoints, the same for each of the D dimensions, conditioned
on the values y at some of them (Eq. gp_posterior). Endpoint conditioning is O = {0, T-1}, via-points are
more indices, and a source conditioned on nothing is O = {}.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from conflow.flow.threads import one_thread

ENDPOINTS = (0, -1)
LONGEST = 10.0
"""Largest length scale that a fit returns: straight demonstrations would push it to infinity."""
SMALLEST = 1e-6
"""Smallest parameter that a fit returns: white noise would push the length scale to zero, still ones sigma_f."""
ROUNDING = 1e-8
"""Asymmetry of a covariance, relative to its largest entry, that is taken for rounding."""


class Source(nn.Module):
    """x_0 | y ~ N(W y, Sigma), with W = K_:O (K_OO + R)^-1 and Sigma = K - W K_O:.

    Where an observation has no noise, x_0 equals y to the last bit: W's row there is a unit vector and Sigma's
    factor has a row of zeros.

    Args:
        K: prior covariance of the waypoints, (T, T); factored once, in float64.
        index: the conditioned waypoints O, negative ones counted from the end.
        noise: variance of each observation, R = diag(noise); zero where omitted.
        modes: keep this many leading eigenvectors of Sigma, or as many as there are; None keeps all. A smooth
            kernel has all its variance in a few, and the others hold its white part epsilon alone.

    Attributes:
        covariance: Sigma, (T, T).
        modes: E, eigenvectors of Sigma as columns, the leading one first, (T, m).
        variance: their eigenvalues, (m,).

    Raises:
        ValueError: K is not symmetric positive semi-definite, an index is out of range or given twice, or a
            variance is negative.
    """

    prior: Tensor
    index: Tensor
    mean_map: Tensor
    covariance: Tensor
    modes: Tensor
    variance: Tensor
    sampling_map: Tensor

    @one_thread()
    def __init__(
        self, K: Tensor, index: Sequence[int] = (), noise: Sequence[float] = (), modes: int | None = None
    ) -> None:
        super().__init__()
        self.kept = modes
        K = K.double()
        _check_covariance(K)
        K = (K + K.mT) / 2
        observed, R = _observations(len(K), index, noise)
        try:
            W = torch.linalg.solve(K[observed][:, observed] + R.diag(), K[observed]).mT
        except RuntimeError:
            raise ValueError(
                f"conditioned waypoints {list(index)}: expected a covariance that tells them apart"
            ) from None
        exact = observed[R == 0]
        W[exact] = torch.eye(len(observed), dtype=K.dtype)[R == 0]
        Sigma = K - W @ K[observed]
        Sigma[exact] = 0
        Sigma[:, exact] = 0
        Sigma = (Sigma + Sigma.mT) / 2
        E, variance = _eigenvectors(Sigma, exact, modes)
        self.register_buffer("prior", K)
        self.register_buffer("index", observed)
        self.register_buffer("mean_map", W)
        self.register_buffer("covariance", Sigma if modes is None else E * variance @ E.mT)
        self.register_buffer("modes", E)
        self.register_buffer("variance", variance)
        self.register_buffer("sampling_map", torch.cat([W, E * variance.sqrt()], dim=1).to(torch.get_default_dtype()))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Source":
        """As of any module, but float64 stays as it is, on the CPU: some devices lack it, and none needs it."""
        super()._apply(  # type: ignore[no-untyped-call]
            lambda tensor: tensor if tensor.dtype == torch.float64 else fn(tensor), recurse
        )
        return self

    def observe(self, x: Tensor) -> Tensor:
        """The values y of trajectories x (batch, T, D) at the conditioned waypoints, (batch, O, D)."""
        return x[:, self.index]

    def mean(self, y: Tensor) -> Tensor:
        """W y: the mean trajectory given y (batch, O, D), in y's precision, (batch, T, D)."""
        return self.mean_map.to(y.dtype).to(y.device) @ y  # in this order, for devices without float64

    def condition(self, index: Sequence[int], noise: Sequence[float] = ()) -> "Source":
        """The same prior K conditioned on other waypoints, whatever this source is conditioned on.

        Raises:
            ValueError: as the class.
        """
        return Source(self.prior, index, noise, self.kept)

    def sample(self, y: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """x_0 ~ p_0(. | y), one trajectory (T, D) for each row of y (batch, O, D): W y + L z, as one product."""
        batch, observations, D = y.shape
        free = self.sampling_map.shape[1] - observations
        z = torch.randn(batch, D, free, dtype=y.dtype, device=y.device, generator=generator)
        return (torch.cat([y.mT, z], dim=-1) @ self.sampling_map.mT).mT


@one_thread()
def rbf(T: int, length_scale: float | Tensor, sigma_f: float | Tensor, epsilon: float) -> Tensor:
    """K_ij = sigma_f^2 exp(-(s_i - s_j)^2 / (2 l^2)) + epsilon delta_ij with s_i = i / (T - 1), float64 (T, T)."""
    s = torch.linspace(0, 1, T, dtype=torch.float64)
    squares = (s[:, None] - s) ** 2
    return sigma_f**2 * torch.exp(-squares / (2 * length_scale**2)) + epsilon * torch.eye(T, dtype=torch.float64)


def gaussian(T: int, modes: int | None = None) -> Source:
    """The standard normal N(0, I): independent waypoints, conditioned on nothing.

    >>> gaussian(3).covariance.tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return Source(torch.eye(T), modes=modes)


def gp(
    T: int, length_scale: float = 0.4, sigma_f: float = 1.0, epsilon: float = 1e-6, modes: int | None = None
) -> Source:
    """p_GP: the RBF process, conditioned on nothing.

    >>> gp(32, sigma_f=2.0, epsilon=0.5).covariance.diagonal()[0].item()
    4.5
    """
    return Source(rbf(T, length_scale, sigma_f, epsilon), modes=modes)


def cgp(
    T: int, length_scale: float = 0.4, sigma_f: float = 1.0, epsilon: float = 1e-6, modes: int | None = None
) -> Source:
    """p_CGP: the RBF process, conditioned on start and goal (Eq. GP_source_dist).

    >>> y = torch.tensor([[[-0.8], [0.8]]])  # one start and one goal, in one dimension
    >>> torch.equal(cgp(32).sample(y)[:, [0, -1]], y)
    True
    """
    return Source(rbf(T, length_scale, sigma_f, epsilon), ENDPOINTS, modes=modes)


@one_thread()
def fit_rbf(x: Tensor, index: Sequence[int] = (), epsilon: float = 1e-6) -> tuple[float, float]:
    """Maximum-likelihood (length_scale, sigma_f) of the source conditioned at `index`, for demonstrations x.

    Maximises log p(x_F | x_O), the sum over trajectories and dimensions, F being the waypoints not in O. The
    data enter through their second moment S = mean x x^T (T, T) alone: with A = (I, -W) the map to residuals,
    -2 log p = log det Sigma_FF + tr(Sigma_FF^-1 A S A^T) + constant.

    Args:
        x: demonstrations, (N, T, D).
        index: the conditioned waypoints O.
        epsilon: the kernel's, which stays as it is.

    Raises:
        ValueError: there are no demonstrations, none of their waypoints is free, or epsilon is too small.
    """
    N, T, D = x.shape
    if not x.numel() or len(index) >= T:
        raise ValueError(f"demonstrations of shape {(N, T, D)}: expected some, with a waypoint that is not conditioned")
    x = x.double()
    S = torch.einsum("nid,njd->ij", x, x) / (N * D)
    observed, _ = _observations(T, index, ())
    free = torch.tensor([i for i in range(T) if i not in observed.tolist()])
    log_parameters = torch.tensor([0.4, 1.0], dtype=torch.float64).log().requires_grad_()
    optimizer = torch.optim.LBFGS([log_parameters], max_iter=200, line_search_fn="strong_wolfe")

    def deviance() -> Tensor:
        optimizer.zero_grad()
        length_scale, sigma_f = log_parameters.exp()
        K = rbf(T, length_scale.clamp(SMALLEST, LONGEST), sigma_f.clamp(SMALLEST), epsilon)
        W = torch.linalg.solve(K[observed][:, observed], K[observed][:, free]).mT
        Sigma = K[free][:, free] - W @ K[observed][:, free]
        A = torch.zeros(len(free), T, dtype=torch.float64)
        A[:, free] = torch.eye(len(free), dtype=torch.float64)
        A = A.index_add(1, observed, -W)
        try:
            L = torch.linalg.cholesky(Sigma)
        except RuntimeError:
            raise ValueError(
                f"epsilon={epsilon:g}: expected a larger one, with which length_scale={length_scale.item():.3g} and "
                f"sigma_f={sigma_f.item():.3g} can be factored"
            ) from None
        value = 2 * L.diagonal().log().sum() + torch.cholesky_solve(A @ S @ A.mT, L).diagonal().sum()
        value.backward()
        return value

    optimizer.step(deviance)
    fitted: list[float] = log_parameters.detach().exp().tolist()
    return max(SMALLEST, min(fitted[0], LONGEST)), max(SMALLEST, fitted[1])


def _check_covariance(K: Tensor) -> None:
    if not bool(torch.isfinite(K).all()) or not torch.allclose(K, K.mT, rtol=0, atol=ROUNDING * float(K.abs().max())):
        raise ValueError("covariance: expected a finite symmetric matrix")
    # Rounding alone makes the smallest eigenvalue of a smooth kernel negative, by some 1e-16 of the trace.
    if bool((torch.linalg.eigvalsh(K) < -1e-9 * K.diagonal().abs().sum()).any()):
        raise ValueError("covariance: expected a positive semi-definite matrix")


def _observations(T: int, index: Sequence[int], noise: Sequence[float]) -> tuple[Tensor, Tensor]:
    """The conditioned waypoints as indices in [0, T) and their variances, both (O,)."""
    if any(not -T <= i < T for i in index):
        raise ValueError(f"conditioned waypoints {list(index)}: expected indices within the {T} waypoints")
    observed = torch.tensor([i % T for i in index], dtype=torch.long)
    if len(observed.unique()) < len(observed):
        raise ValueError(f"conditioned waypoints {list(index)}: expected each waypoint at most once")
    R = torch.tensor(list(noise) or [0.0] * len(observed), dtype=torch.float64)
    if len(R) != len(observed) or not bool((R >= 0).all()):
        raise ValueError(f"observation noise {list(noise)}: expected {len(observed)} variances of at least 0")
    return observed, R


def _eigenvectors(Sigma: Tensor, exact: Tensor, modes: int | None) -> tuple[Tensor, Tensor]:
    """Eigenvectors of Sigma (T, m), with rows of zeros where an observation is exact, and eigenvalues (m,)."""
    free = torch.ones(len(Sigma), dtype=torch.bool)
    free[exact] = False
    # Eigenvectors rather than Cholesky: long length scales leave Sigma singular to rounding.
    variance, U = torch.linalg.eigh(Sigma[free][:, free])
    E = torch.zeros(len(Sigma), len(variance), dtype=Sigma.dtype)
    E[free] = U
    return E.flip(1)[:, :modes].contiguous(), variance.flip(0)[:modes].clamp_min(0)
