"""The velocity networks v_theta: the paper's (appendix: "Architecture and training details"), and a spectral one."""

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor, nn

from conflow.flow.along import along
from conflow.flow.correction import Differentiable
from conflow.flow.source import Source

SEEN = 4.0
"""Standard deviations beyond which there is next to nothing to learn from."""
FAINT = 0.1
"""Of the source's width in a mode: where demonstrations are narrower, x_t shows the source's noise and little else."""
SLIGHT = 0.01
"""Of the source's width in the leading mode: where it is narrower, its noise hardly moves x_t."""
NARROWEST = 1000.0
"""How many times narrower than the leading mode one is that still counts as narrow, and not as empty."""


class ResidualBlock(nn.Module):
    """h + W_2 silu(W_1 h)."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden))

    def forward(self, h: Tensor) -> Tensor:
        return h + self.layers(h)


class Velocity(nn.Module):
    """What all velocity networks have: a precision of their layers.

    Attributes:
        bf16: whether the layers take bf16 factors while the network is trained. Weights, sums, all that is no layer,
            and sampling stay in single precision.
    """

    bf16 = False

    def layers(self, x: Tensor) -> AbstractContextManager[None]:
        """Where the layers are evaluated, for an input on the device of x."""
        return torch.autocast(x.device.type, torch.bfloat16) if self.bf16 and self.training else nullcontext()


class ResMLP(Velocity):
    """v_theta(x, t): a residual MLP on the flattened trajectory and the scalar time.

    Args:
        T, D: waypoints and dimensions of a trajectory.
        hidden: width; the paper's is 1024.
        blocks: residual blocks; the paper's are 4.
        sees_ends: whether start and goal are inputs too. The paper does not say.
    """

    def __init__(self, T: int, D: int, hidden: int = 1024, blocks: int = 4, sees_ends: bool = False) -> None:
        super().__init__()
        self.sees_ends = sees_ends
        self.inlet = nn.Linear((T + 2 * sees_ends) * D + 1, hidden)
        self.blocks = nn.Sequential(*(ResidualBlock(hidden) for _ in range(blocks)))
        self.outlet = nn.Linear(hidden, T * D)

    def forward(self, x: Tensor, t: Tensor, ends: Tensor | None = None) -> Tensor:
        """The velocity at x (batch, T, D) and t (batch,), for starts and goals (batch, 2, D), (batch, T, D)."""
        seen = [x.flatten(1), t[:, None]]
        if self.sees_ends:
            if ends is None:
                raise ValueError("ends: expected starts and goals, which this network sees, found none")
            seen.append(ends.flatten(1))
        with self.layers(x):
            v = self.outlet(self.blocks(self.inlet(torch.cat(seen, dim=1))))
        return v.to(x.dtype).view_as(x)


class Spectral(Velocity, ABC):
    """v_theta in the eigenvectors E of the source's Sigma: v(x, t) = E (a(t) z + c(t) h_theta), z = E^T (x - W x_O).

    Each mode has a variance sigma_0^2 under the source, its eigenvalue, and sigma_1^2 among the demonstrations. Were
    both laws Gaussian, the flow between them would have the velocity a z with
    a = (t sigma_1^2 - (1 - t) sigma_0^2) / sigma_t^2 and sigma_t^2 = t^2 sigma_1^2 + (1 - t)^2 sigma_0^2. This part is
    in closed form; the network h_theta learns the rest, of size c = sigma_0 sigma_1 / sigma_t. So the output is as
    smooth as the modes are, and stays where the source is conditioned to the last bit.

    h_theta sees z / sigma_t, the conditioned values x_O, Fourier features of t, clearances, and grad C in the modes.
    Of z / sigma_t it sees no more than +-SEEN: where a correction has pushed x out of all that training shows, in a
    mode that is narrow, h_theta is not asked for what it never learned, and a z alone brings it back. Of a mode in
    which the source is SLIGHT and demonstrations are FAINT it sees nothing: there is only noise.

    Args:
        source: its modes, usually a few leading ones.
        D: the dimensions that have variances of their own; 1 where all have the same.
        constraint: gives clearance and grad C.
        frequencies: of the features sin(k pi t), cos(k pi t).
    """

    observed: Tensor
    modes: Tensor
    analysis: Tensor
    source_variance: Tensor
    variance: Tensor
    frequencies: Tensor
    outlet: nn.Linear

    def __init__(self, source: Source, D: int, constraint: Differentiable, frequencies: int = 8) -> None:
        super().__init__()
        self.constraint = constraint
        m, dtype = source.modes.shape[1], torch.get_default_dtype()
        self.register_buffer("observed", source.index, persistent=False)
        self.register_buffer("modes", source.modes.to(dtype), persistent=False)
        self.register_buffer("analysis", _analysis(source).to(dtype), persistent=False)
        self.register_buffer("source_variance", source.variance.to(dtype)[:, None].expand(m, D), persistent=False)
        # Of the demonstrations, so a checkpoint has to hold it.
        self.register_buffer("variance", self.source_variance.clone())
        self.register_buffer("frequencies", torch.pi * torch.arange(1, frequencies + 1), persistent=False)

    def fit(self, x_1: Tensor) -> None:
        """Set sigma_1^2 to the second moments of demonstrations x_1 (N, T, D) about W x_O.

        At least the square of rounding, which x_1 of size 1 has: a mode that is empty ends as empty as it can be.
        """
        squares = self.coordinates(x_1).square().mean(dim=0)
        if self.variance.shape[1] == 1:
            squares = squares.mean(dim=1, keepdim=True)
        self.variance = squares.clamp_min(torch.finfo(x_1.dtype).eps ** 2)

    def coordinates(self, x: Tensor) -> Tensor:
        """z = E^T (x - W x_O), (batch, m, D)."""
        return along(self.analysis, x)

    def balanced(self, u: Tensor) -> Tensor:
        """A velocity u (batch, T, D) in the modes, each over the root of its sigma_1, (batch, m, D).

        A field that is nearest in this norm is the same as in any other, the conditional mean, but a network that
        cannot be everywhere attends less to the wide modes and more to the narrow ones, in which roughness is. The
        leading mode counts as it is, and none more than a thousandfold: those that demonstrations do not have are
        in closed form.
        """
        sigma_1 = self.variance.sqrt()
        return (sigma_1[0] / sigma_1).clamp(max=NARROWEST).sqrt() * along(self.modes.mT, u)

    def forward(self, x: Tensor, t: Tensor, ends: Tensor | None = None) -> Tensor:
        """The velocity at x (batch, T, D) and t (batch,), (batch, T, D); start and goal it takes from x."""
        # In the memory layout of what it is combined with.
        z, s = self.coordinates(x).contiguous(), t[:, None, None]
        sigma_t = (s**2 * self.variance + (1 - s) ** 2 * self.source_variance).sqrt()
        a = (s * self.variance - (1 - s) * self.source_variance) / sigma_t**2
        c = (self.source_variance * self.variance).sqrt() / sigma_t
        faint = self.variance <= FAINT**2 * self.source_variance
        slight = self.source_variance <= SLIGHT**2 * self.source_variance[0]
        bound = SEEN * ~(faint & slight)
        return along(self.modes, a * z + c * self.rest(x, (z / sigma_t).clamp(-bound, bound), t))

    @abstractmethod
    def rest(self, x: Tensor, z: Tensor, t: Tensor) -> Tensor:
        """h_theta at x (batch, T, D), z / sigma_t (batch, m, D) and t (batch,), (batch, m, D)."""

    def clock(self, t: Tensor) -> list[Tensor]:
        """t and its Fourier features, (batch, ...) each."""
        angles = t[:, None] * self.frequencies
        return [t[:, None], angles.sin(), angles.cos()]

    def pushed(self, grad_C: Tensor) -> Tensor:
        """grad C (batch, T, D) in the modes, each as wide as the source is in it, (batch, m, D)."""
        return (self.source_variance / self.source_variance[0]).sqrt() * along(self.modes.mT, grad_C)


def _analysis(source: Source) -> Tensor:
    """The matrix E^T (I - W O), float64 (m, T), with O x = x_O: of x to its coordinates z."""
    A = source.modes.mT.clone()
    A[:, source.index] -= source.modes.mT @ source.mean_map
    return A


class SpectralMLP(Spectral):
    """The residual MLP as h_theta, for robots whose number never changes.

    Args:
        source, D, constraint, frequencies: of `Spectral`.
        hidden: width.
        blocks: residual blocks.
    """

    def __init__(
        self,
        source: Source,
        D: int,
        constraint: Differentiable,
        hidden: int = 256,
        blocks: int = 4,
        frequencies: int = 8,
    ) -> None:
        super().__init__(source, D, constraint, frequencies)
        (T, m), observations = source.modes.shape, len(source.index)
        self.inlet = nn.Linear(2 * m * D + observations * D + 1 + 2 * frequencies + T, hidden)
        self.blocks = nn.Sequential(*(ResidualBlock(hidden) for _ in range(blocks)))
        self.outlet = nn.Linear(hidden, m * D)
        nn.init.zeros_(self.outlet.weight)  # training starts from the Gaussian flow
        nn.init.zeros_(self.outlet.bias)

    def rest(self, x: Tensor, z: Tensor, t: Tensor) -> Tensor:
        clearance, grad_C = self.constraint.clearance_and_gradient(x)
        near = 4 * clearance.clamp(max=1)  # only the near ones matter
        values = [z.flatten(1), x[:, self.observed].flatten(1), *self.clock(t), near, self.pushed(grad_C).flatten(1)]
        with self.layers(x):
            h = self.outlet(self.blocks(self.inlet(torch.cat(values, dim=1))))
        return h.to(z.dtype).view_as(z)
