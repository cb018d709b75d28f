"""The velocity network v_theta."""

import pytest
import torch
from torch import nn

from conflow.flow.network import ResidualBlock, ResMLP


def network() -> ResMLP:
    torch.manual_seed(0)
    return ResMLP(T=5, D=2, hidden=16, blocks=2)


def inputs(batch: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(batch, 5, 2, generator=generator), torch.rand(batch, generator=generator)


def test_the_velocity_depends_on_each_trajectorys_own_time() -> None:
    """Another t for one trajectory of the batch changes that trajectory's velocity and no other."""
    v = network()
    x, t = inputs()
    later = t.clone()
    later[2] += 0.3
    changed = (v(x, later) - v(x, t)).abs().amax(dim=(1, 2))
    # Rounding is some 1e-7, an influence of t some 1e-2.
    assert (changed > 1e-4).tolist() == [False, False, True, False]


def test_every_waypoint_sees_every_other() -> None:
    """The trajectory is flattened: each component of the velocity depends on each component of x."""
    x, t = inputs(1)
    v = network()
    jacobian = torch.autograd.functional.jacobian(lambda x: v(x, t), x)
    assert isinstance(jacobian, torch.Tensor)
    assert bool((jacobian != 0).all())


def test_a_block_adds_to_what_it_is_given() -> None:
    """A block whose second layer is zero is the identity, h + W_2 silu(W_1 h)."""
    block = ResidualBlock(8)
    h = torch.randn(3, 8, generator=torch.Generator().manual_seed(0))
    W_1, _, W_2 = block.layers
    assert isinstance(W_1, nn.Linear)
    assert isinstance(W_2, nn.Linear)
    z = W_1(h)
    torch.testing.assert_close(block(h), h + W_2(z * torch.sigmoid(z)))
    nn.init.zeros_(W_2.weight)
    nn.init.zeros_(W_2.bias)
    assert torch.equal(block(h), h)


def test_the_papers_network_has_the_papers_size() -> None:
    """T = 32, D = 4, hidden 1024, 4 blocks: the weights written out, and 107 GFLOP a training step of 2048."""
    with torch.device("meta"):
        parameters = sum(p.numel() for p in ResMLP(32, 4, hidden=1024, blocks=4).parameters())
    inlet, block, outlet = (128 + 1) * 1024 + 1024, 2 * (1024 * 1024 + 1024), 1024 * 128 + 128
    assert parameters == inlet + 4 * block + outlet
    # A multiply-add is two operations, the backward pass costs twice the forward one.
    assert 6 * 2048 * parameters == pytest.approx(107e9, rel=0.02)
