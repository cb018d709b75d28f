"""The velocity networks v_theta."""

import pytest
import torch
from torch import nn

from conflow.flow.network import FAINT, SEEN, SLIGHT, ResidualBlock, ResMLP, SpectralMLP
from conflow.flow.sampler import integrate
from conflow.flow.source import ENDPOINTS, Source, rbf
from conflow.scene.tasks.swap import swap
from tests.papers import keep_apart


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


def spectral(modes: int = 8) -> tuple[SpectralMLP, Source]:
    torch.manual_seed(0)
    source = Source(rbf(32, 0.4, 1.0, 1e-6), ENDPOINTS, modes=modes)
    v = SpectralMLP(source, 4, keep_apart(2), hidden=32, blocks=1)
    nn.init.normal_(v.outlet.weight, std=0.3)
    return v, source


def test_a_spectral_velocity_is_zero_at_start_and_goal_and_within_the_modes() -> None:
    """v = E (...): endpoints to the last bit, and nothing outside the span of E."""
    v, source = spectral()
    x = source.sample(source.observe(swap(100)))
    velocity = v(x, torch.rand(100, generator=torch.Generator().manual_seed(1)))
    assert not velocity[:, [0, -1]].any()
    E = source.modes.float()
    torch.testing.assert_close(E @ (E.mT @ velocity), velocity, rtol=0, atol=1e-5)  # float32 rounding
    assert velocity.norm() > 1


def test_no_white_part_of_the_source_survives() -> None:
    """The source of few modes lies in them, and the flow stays there: eighth differences are rounding."""
    v, source = spectral()
    y = source.observe(swap(100))
    x_1 = integrate(v, source.sample(y), steps=3, solver="midpoint")
    assert torch.equal(source.observe(x_1), y)
    residual = (x_1 - source.mean(y)).double()
    outside = residual - source.modes @ (source.modes.mT @ residual)
    assert outside.abs().max() < 1e-5  # the full source's epsilon is 1e-3


def test_what_the_demonstrations_do_not_have_does_not_survive() -> None:
    """Where they have nothing, a mode of the source ends at rounding: else white noise of 3e-4 makes samples rough."""
    v, source = spectral(modes=30)
    nn.init.zeros_(v.outlet.weight)
    v.fit(swap(500))
    x_1 = integrate(v, source.sample(source.observe(swap(100))), steps=20)
    empty = v.variance.mean(dim=1) < 1e-10
    assert empty.sum() > 10
    assert v.coordinates(x_1)[:, empty].abs().max() < 2e-6  # coordinates are of size 1, in float32


def test_an_untrained_spectral_network_is_the_flow_between_two_gaussians() -> None:
    """Its ODE takes N(0, sigma_0^2) to N(0, sigma_1^2) in each mode: z_1 = sigma_1 / sigma_0 z_0."""
    v, source = spectral(modes=4)
    nn.init.zeros_(v.outlet.weight)
    factor = torch.tensor([[0.5, 0.1, 2.0, 1.0]]).mT * torch.linspace(0.5, 1.5, 4)
    v.variance = factor**2 * v.source_variance
    x_0 = source.sample(source.observe(swap(50)), torch.Generator().manual_seed(0))
    x_1 = integrate(v, x_0, steps=400, solver="rk4")
    # Of a step of 1/400 the fourth-order error is below float32's rounding, some 1e-6 over 400 steps.
    torch.testing.assert_close(v.coordinates(x_1), factor * v.coordinates(x_0), rtol=1e-3, atol=1e-4)


def test_far_off_what_training_shows_only_the_closed_form_acts() -> None:
    """Beyond +-SEEN the network is blind: v differs by E a z alone, which in a narrow mode leads straight back."""
    v, source = spectral()
    v.double()  # of differences little is left in single precision
    v.variance = (2 * FAINT) ** 2 * v.source_variance  # the demonstrations are much narrower
    # So far apart that neither clearance nor gradient tells.
    x = torch.tensor([0.0, 1, 0, -1]).double().expand(1, 32, 4)
    t = torch.tensor([0.5]).double()
    trailing = source.modes[:, -1:] * torch.tensor([0.0, 1, 0, 1])
    sigma_t = (0.25 * (v.variance + v.source_variance))[-1, 0].sqrt()
    near, far = (v(x + deviations * sigma_t * trailing, t) for deviations in (2 * SEEN, 5 * SEEN))
    a = (0.5 * (v.variance - v.source_variance) / (0.25 * (v.variance + v.source_variance)))[-1, 0]
    torch.testing.assert_close(far - near, a * 3 * SEEN * sigma_t * trailing[None], rtol=1e-6, atol=1e-7)
    seen = v(x + SEEN / 2 * sigma_t * trailing, t) - v(x, t)
    assert not torch.allclose(seen, a * SEEN / 2 * sigma_t * trailing[None], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("mode", "seen"), [(-1, False), (0, True)])
def test_the_network_sees_no_mode_that_is_only_noise(mode: int, seen: bool) -> None:
    """Where demonstrations are faint and the source is slight a z alone acts; a wide source decides where x_t is."""
    v, source = spectral()
    v.double()  # of differences little is left in single precision
    v.variance = v.source_variance.clone()
    v.variance[mode] = (FAINT / 2) ** 2 * v.source_variance[mode]
    # So far apart that neither clearance nor gradient tells.
    x = torch.tensor([0.0, 1, 0, -1]).double().expand(1, 32, 4)
    t = torch.tensor([0.5]).double()
    assert (v.source_variance[mode, 0] <= SLIGHT**2 * v.source_variance[0, 0]) != seen
    shift = 0.1 * v.source_variance[mode, 0].sqrt() * source.modes[:, mode, None] * torch.tensor([0.0, 1, 0, 1])
    a = (0.5 * (v.variance - v.source_variance) / (0.25 * (v.variance + v.source_variance)))[mode, 0]
    by_closed_form = torch.allclose(v(x + shift, t) - v(x, t), a * shift[None], rtol=1e-6, atol=1e-9)
    assert by_closed_form != seen


def test_the_variance_of_the_demonstrations_is_kept_in_a_checkpoint() -> None:
    v, _ = spectral()
    v.fit(swap(500))
    z = v.coordinates(swap(500))
    torch.testing.assert_close(v.variance, z.square().mean(dim=0), rtol=1e-6, atol=2e-14)  # the floor
    other, _ = spectral()
    assert not torch.equal(other.variance, v.variance)
    other.load_state_dict(v.state_dict())
    assert torch.equal(other.variance, v.variance)
