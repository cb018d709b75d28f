"""A velocity network for robots of any number: every robot is a token, and robots attend to each other."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from conflow.flow.correction import Differentiable
from conflow.flow.network import Spectral
from conflow.flow.source import Source

HEADS = 4
MOMENTS = 16
"""Waypoints, evenly spaced, at which robots see how near they are to each other."""
RANGE = 0.2
"""Gaps beyond this, in workspace units, fade from sight."""

Apart = Callable[[Tensor], Tensor]
"""The gap between every two robots at every waypoint of x (batch, T, D), (batch, T, robots, robots)."""


class SpectralAttention(Spectral):
    """Attention between robots as h_theta: the same weights for any number of them, whatever their order.

    A token holds one robot's z / sigma_t, grad C in the modes, start and goal, the time, and how near the nearest other
    comes at MOMENTS waypoints. How much robot i attends to robot j depends on their tokens, and on the pair's own gaps
    at these waypoints, through a bias.

    Args:
        source, constraint, frequencies: of `Spectral`.
        each: numbers of a configuration that are one robot's.
        apart: the gaps between robots.
        hidden: width of a token.
        blocks: of attention.
    """

    moments: Tensor

    def __init__(
        self,
        source: Source,
        each: int,
        constraint: Differentiable,
        apart: Apart,
        hidden: int = 128,
        blocks: int = 3,
        frequencies: int = 8,
    ) -> None:
        super().__init__(source, 1, constraint, frequencies)
        (T, m), observations = source.modes.shape, len(source.index)
        self.each, self.apart = each, apart
        self.register_buffer("moments", torch.linspace(0, T - 1, MOMENTS).round().long(), persistent=False)
        self.inlet = nn.Linear((2 * m + observations) * each + 1 + 2 * frequencies + MOMENTS, hidden)
        self.closeness = nn.Linear(MOMENTS, blocks * HEADS)
        self.blocks = nn.ModuleList(AttentionBlock(hidden) for _ in range(blocks))
        self.outlet = nn.Linear(hidden, m * each)
        nn.init.zeros_(self.outlet.weight)  # training starts from the Gaussian flow
        nn.init.zeros_(self.outlet.bias)

    def rest(self, x: Tensor, z: Tensor, t: Tensor) -> Tensor:
        near = self._near(x)
        others = near.masked_fill(torch.eye(near.shape[2], dtype=torch.bool, device=x.device)[..., None], 0)
        clock = torch.cat(self.clock(t), dim=1)[:, None].expand(-1, near.shape[2], -1)
        own = [self._by_robot(part) for part in (z, self.pushed(self.constraint.gradient(x)), x[:, self.observed])]
        with self.layers(x):
            h = self.inlet(torch.cat([*own, clock, others.amax(dim=2)], dim=2))
            biases = self.closeness(others).permute(0, 3, 1, 2).chunk(len(self.blocks), dim=1)
            for block, bias in zip(self.blocks, biases, strict=True):
                h = block(h, bias)
            h = self.outlet(h)
        return h.to(z.dtype).unflatten(2, (-1, self.each)).transpose(1, 2).flatten(2)

    def _by_robot(self, z: Tensor) -> Tensor:
        """Numbers (batch, n, D) of each robot side by side, (batch, robots, n each)."""
        return z.unflatten(2, (-1, self.each)).transpose(1, 2).flatten(2)

    def _near(self, x: Tensor) -> Tensor:
        """exp(-gap / RANGE) of every two robots, at most about 1, (batch, robots, robots, MOMENTS)."""
        gaps = self.apart(x[:, self.moments]).permute(0, 2, 3, 1)
        return torch.exp(-gaps.clamp(min=0) / RANGE)


class AttentionBlock(nn.Module):
    """h + attention(h), then h + W_2 silu(W_1 h), each of a normalised h."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.before, self.between = nn.LayerNorm(hidden), nn.LayerNorm(hidden)
        self.query_key_value = nn.Linear(hidden, 3 * hidden)
        self.mix = nn.Linear(hidden, hidden)
        self.layers = nn.Sequential(nn.Linear(hidden, 2 * hidden), nn.SiLU(), nn.Linear(2 * hidden, hidden))

    def forward(self, h: Tensor, bias: Tensor) -> Tensor:
        """Tokens h (batch, robots, hidden), with a bias (batch, HEADS, robots, robots) of every pair."""
        q, k, v = self.query_key_value(self.before(h)).unflatten(2, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=bias)
        h = h + self.mix(attended.transpose(1, 2).flatten(2))
        return h + self.layers(self.between(h))
