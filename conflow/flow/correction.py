"""The constraint-induced correction u^c of the velocity (paper: "Constraint-Guided Objective", appendix)."""

from typing import Protocol

import torch
from torch import Tensor, nn


class Differentiable(Protocol):
    """What this wing needs of a constraint: the gradient of its barrier C."""

    def gradient(self, x: Tensor) -> Tensor:
        """grad C at x, both (batch, T, D)."""
        ...


class Correction(nn.Module):
    """u^c(x) = S grad C(x): the barrier's gradient, smoothed along the trajectory by the matrix S.

    Args:
        constraint: gives grad C.
        smoothing: S, (T, T).
    """

    smoothing: Tensor

    def __init__(self, constraint: Differentiable, smoothing: Tensor) -> None:
        super().__init__()
        self.constraint = constraint
        # Both follow from the config, so a checkpoint need not hold them.
        self.register_buffer("smoothing", smoothing.to(torch.get_default_dtype()), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """u^c at x, both (batch, T, D)."""
        return (self.constraint.gradient(x).mT @ self.smoothing.mT).mT


def gaussian_filter(T: int, sigma: float = 5.0, width: int = 9) -> Tensor:
    """The Gaussian filter along the trajectory as a matrix, float64 (T, T).

    S_ij = w_{i-j} / sum w with w_k = exp(-k^2 / (2 sigma^2)) for |k| <= (width - 1) / 2. Beyond the ends the
    gradient counts as zero.
    """
    k = torch.arange(T, dtype=torch.float64)
    offset = k[:, None] - k
    reach = (width - 1) // 2
    taps = torch.arange(-reach, reach + 1, dtype=torch.float64)
    w = torch.exp(-(offset**2) / (2 * sigma**2)) * (offset.abs() <= reach)
    return w / torch.exp(-(taps**2) / (2 * sigma**2)).sum()
