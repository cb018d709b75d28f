"""The velocity network v_theta (paper, appendix: "Architecture and training details")."""

import torch
from torch import Tensor, nn


class ResidualBlock(nn.Module):
    """h + W_2 silu(W_1 h)."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden))

    def forward(self, h: Tensor) -> Tensor:
        return h + self.layers(h)


class ResMLP(nn.Module):
    """v_theta(x, t): a residual MLP on the flattened trajectory and the scalar time.

    Args:
        T, D: waypoints and dimensions of a trajectory.
        hidden: width; the paper's is 1024.
        blocks: residual blocks; the paper's are 4.
    """

    def __init__(self, T: int, D: int, hidden: int = 1024, blocks: int = 4) -> None:
        super().__init__()
        self.inlet = nn.Linear(T * D + 1, hidden)
        self.blocks = nn.Sequential(*(ResidualBlock(hidden) for _ in range(blocks)))
        self.outlet = nn.Linear(hidden, T * D)

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        """The velocity at x (batch, T, D) and t (batch,), (batch, T, D)."""
        h = self.inlet(torch.cat([x.flatten(1), t[:, None]], dim=1))
        return self.outlet(self.blocks(h)).view_as(x)
