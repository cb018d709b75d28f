from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.fx.experimental import _config
from torch.utils._python_dispatch import TorchDispatchMode

from conflow.flow.network import SpectralMLP
from conflow.flow.path import guided_path, interpolate
from conflow.flow.sampler import PIECE, integrate
from conflow.flow.source import ENDPOINTS, fit_rbf
from conflow.scene.measures import smoothness
from conflow.scene.tasks.swap import swap
from conflow.training import config
from conflow.training.build import fitted, random_stream
from conflow.training.config import Config
from conflow.training.datamodule import DemonstrationData
from conflow.training.model import start_and_goal
from conflow.training.module import Training
from tests.papers import SETTINGS, TWO, model_of


def model(*arguments: str) -> Training:
    torch.manual_seed(0)
    return model_of(config.load(["preset=smoke", *arguments]), 32, 4)


def closest(x: Tensor) -> Tensor:
    return (x[..., :2] - x[..., 2:]).norm(dim=-1).amin(dim=1)


def noise() -> torch.Generator:
    return random_stream("test", 0)


def test_where_nothing_violates_the_guided_loss_is_that_of_flow_matching() -> None:
    x_1, feasible = swap(200), torch.zeros(200, dtype=torch.bool)
    guided, plain = model("correction.lambda_c=2.5"), model("correction.lambda_c=0")
    plain.load_state_dict(guided.state_dict())
    assert torch.equal(guided.loss(x_1, feasible, noise()), plain.loss(x_1, feasible, noise()))
    assert not torch.equal(guided.loss(x_1, ~feasible, noise()), plain.loss(x_1, ~feasible, noise()))


@pytest.mark.parametrize("reduction", ["sum", "mean", "closest"])
def test_the_loss_is_algorithm_1_written_out(reduction: str) -> None:
    """Gradient by autograd, smoothing by a convolution, conditioning left to the tested source."""
    flow = model(f"constraint.reduction={reduction}")
    x_1 = swap(300)
    M = closest(x_1) < 0.3
    draws = noise()
    x_0 = flow.source.sample(x_1[:, [0, -1]], draws)
    t = torch.rand(300, generator=draws)[:, None, None]
    x_t = ((1 - t) * x_0 + t * x_1).requires_grad_()
    d = (x_t[..., :2] - x_t[..., 2:]).norm(dim=-1)
    d = d.amin(dim=1, keepdim=True) if reduction == "closest" else d
    C = -torch.log(1 + torch.exp(-10 * (d - 0.3))) / 10 / (32 if reduction == "mean" else 1)
    (g,) = torch.autograd.grad(C.sum(), x_t)
    w = torch.exp(-(torch.arange(-4.0, 5.0) ** 2) / (2 * 5.0**2))
    u_c = F.conv1d(g.mT.reshape(-1, 1, 32), (w / w.sum()).view(1, 1, 9), padding=4).view(300, 4, 32).mT
    target = x_1 - x_0 + 2.5 * M[:, None, None] * u_c
    expected = ((flow.v(x_t, t.flatten()) - target) ** 2).mean()
    # Single precision, and exp and log instead of softplus.
    assert flow.loss(x_1, M, noise()).item() == pytest.approx(expected.item(), rel=1e-5)


def test_a_training_step_is_a_function_of_seed_step_and_batch() -> None:
    flow, batch = model(), (swap(64), torch.ones(64, dtype=torch.bool))
    torch.manual_seed(1)
    first = flow.training_step(batch, 5)
    torch.manual_seed(2)
    assert torch.equal(first, flow.training_step(batch, 5))
    assert not torch.equal(first, flow.training_step(batch, 6))
    assert not torch.equal(first, model("seed=1").training_step(batch, 5))


def test_without_guidance_a_sample_is_the_flow_of_the_network_alone() -> None:
    flow = model()
    x_1 = swap(20)
    expected = integrate(flow.v, flow.source.sample(flow.source.observe(x_1), noise()), 10, "euler")
    assert torch.equal(flow.sample(x_1, "none", noise()), expected)


def test_guidance_moves_samples_away_from_what_it_avoids_and_in_proportion_to_its_weight() -> None:
    x_1 = swap(400)
    base, strong = model(), model("sample.robot_weight=3", "sample.obstacle_weight=3")
    for flow in (base, strong):
        torch.nn.init.zeros_(flow.v.outlet.weight)  # a field that stands still leaves guidance alone
        torch.nn.init.zeros_(flow.v.outlet.bias)
    clearance = {
        name: [
            flow.judged["robot"].clearance(flow.sample(x_1, setting, noise())).amin(dim=1).mean().item()
            for setting in SETTINGS
        ]
        for name, flow in (("base", base), ("strong", strong))
    }
    none, robot, _ = clearance["base"]
    assert none < robot < clearance["strong"][1]
    obstacle = [
        base.judged["object"].clearance(base.sample(x_1, setting, noise())).amin(dim=1).mean().item()
        for setting in SETTINGS
    ]
    assert obstacle[2] > obstacle[0]


def test_the_mask_may_be_read_as_feasible() -> None:
    """Algorithm 1's caption against the text: where nothing violates, everything is corrected, and the reverse."""
    x_1, nothing = swap(100), torch.zeros(100, dtype=torch.bool)
    violates, feasible = model(), model("correction.mask=feasible")
    feasible.load_state_dict(violates.state_dict())
    assert torch.equal(feasible.loss(x_1, nothing, noise()), violates.loss(x_1, ~nothing, noise()))
    assert torch.equal(feasible.loss(x_1, ~nothing, noise()), violates.loss(x_1, nothing, noise()))


@pytest.mark.parametrize("kind", ["gaussian", "cgp"])
def test_a_network_that_sees_the_ends_asks_for_them_and_uses_them(kind: str) -> None:
    flow, x_1 = model("network.sees_ends=true", f"source.kind={kind}"), swap(10)
    x_0, t = flow.source.sample(flow.source.observe(x_1), noise()), torch.zeros(10)
    ends = start_and_goal(x_1)
    assert not torch.equal(flow.v(x_0, t, ends), flow.v(x_0, t, ends + 0.1))
    # Every setting passes them on.
    for setting in SETTINGS:
        assert not torch.equal(flow.flow(x_0, setting, ends), flow.flow(x_0, setting, ends + 0.1))
    with pytest.raises(ValueError, match="expected starts and goals"):
        flow.flow(x_0)


def test_samples_may_be_judged_at_another_distance_than_they_were_trained_for() -> None:
    """The label M, the barrier and the network keep the constraint's radius."""
    here, x = model("sample.radius=0.25"), swap(500)
    assert torch.equal(here.judged["robot"].violation(x), closest(x) < 0.25)
    assert torch.equal(here.u_c(x), model().u_c(x))
    assert torch.equal(DemonstrationData(here.config).violates, DemonstrationData(model().config).violates)


def test_robots_may_be_judged_as_points_where_they_meet_the_obstacle() -> None:
    """They are guided around it as the discs that they are."""
    here, x = model("sample.object_radius=0.1"), swap(500)
    centre = torch.tensor([0.0, 0.5])
    nearest = (x.view(500, 32, 2, 2) - centre).norm(dim=3).amin(dim=(1, 2))
    assert torch.equal(here.judged["object"].violation(x), nearest < 0.1)
    assert torch.equal(here.u_c_at_inference["object"](x), model().u_c_at_inference["object"](x))
    assert torch.equal(here.judged["robot"].violation(x), model().judged["robot"].violation(x))


def test_a_correction_may_leave_alone_what_the_source_fixes() -> None:
    u_c = model("correction.keep_ends=true").u_c(swap(100) * 0.1)  # robots near each other everywhere
    assert bool((u_c[:, [0, -1]] == 0).all())
    assert bool((u_c[:, 1] != 0).any())


def test_samples_start_as_smooth_as_the_source() -> None:
    gaussian, cgp = (model(f"source.kind={kind}") for kind in ("gaussian", "cgp"))
    x = swap(100)
    rough, smooth = (
        smoothness(TWO, flow.source.sample(flow.source.observe(x), noise())).mean() for flow in (gaussian, cgp)
    )
    assert smooth < 0.1 * rough


def test_a_fitted_kernel_comes_from_the_demonstrations_and_survives_reloading() -> None:
    settings = config.load(["preset=smoke", "source.fit=true"])
    x = swap(200)
    fitting = fitted(settings, x)
    length_scale, sigma_f = fit_rbf(x, ENDPOINTS, settings.source.epsilon)
    assert (fitting.source.length_scale, fitting.source.sigma_f) == (length_scale, sigma_f)
    assert fitting.source.length_scale != settings.source.length_scale
    one, again = model_of(fitting, 32, 4), model_of(config.from_tree(fitting.tree()), 32, 4)
    again.load_state_dict(one.state_dict())
    assert torch.equal(one.sample(x, "none", noise()), again.sample(x, "none", noise()))


def test_without_fit_the_kernel_stays_as_it_is_set(smoke: Config) -> None:
    assert fitted(smoke, swap(200)) is smoke


@pytest.mark.parametrize("setting", SETTINGS)
def test_samples_do_not_depend_on_how_many_are_asked_for(setting: str) -> None:
    """Nor does what the network sees at a time grow with them; the same again is the same to the last bit."""
    flow = model("network.sees_ends=true", "sample.steps=2")
    seen: list[int] = []
    flow.v.register_forward_hook(lambda _, inputs, __: seen.append(len(inputs[0])))
    x_1 = swap(2 * PIECE + 100)
    x_0, ends = flow.source.sample(flow.source.observe(x_1), noise()), x_1[:, [0, -1]]
    many = flow.flow(x_0, setting, ends)
    assert seen == [PIECE, PIECE, PIECE, PIECE, 100, 100]
    assert torch.equal(many, flow.flow(x_0, setting, ends))
    for rows in (slice(10), slice(PIECE - 5, PIECE + 5), slice(-10, None)):
        # Single precision: matrix products of other sizes round otherwise.
        torch.testing.assert_close(flow.flow(x_0[rows], setting, ends[rows]), many[rows], rtol=0, atol=1e-5)


ABLATIONS = [["ablation=cgp"], ["ablation=plus", "source.fit=false"], ["ablation=guided_path"], ["ablation=gaussian"]]


@pytest.mark.parametrize("ablation", ABLATIONS, ids=lambda arguments: arguments[0])
def test_training_and_sampling_need_a_device_no_float64(ablation: list[str]) -> None:
    """Apple's has none. "meta", which only knows shapes, refuses to mix its tensors with those left on the CPU."""
    flow = model(*ablation, "sample.steps=1").to("meta")
    left = {name for name, tensor in flow.state_dict().items() if tensor.device.type == "cpu"}
    moved = {tensor.dtype for tensor in [*flow.parameters(), *flow.buffers()] if tensor.device.type == "meta"}
    assert left == {f"source.{name}" for name in ("prior", "mean_map", "covariance", "modes", "variance")}
    assert moved <= {torch.float32, torch.int64}
    x_1, M = torch.zeros(8, 32, 4, device="meta"), torch.zeros(8, dtype=torch.bool, device="meta")
    results = [flow.sample(x_1, setting) for setting in SETTINGS]
    results += [flow.loss(x_1, M, None), flow.source.mean(flow.source.observe(x_1))]  # type: ignore[arg-type]
    assert {(result.device.type, result.dtype) for result in results} == {("meta", torch.float32)}


class OneDevice(TorchDispatchMode):
    """Refuses a tensor that is indexed by another device's, which an accelerator refuses and "meta" does not."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func._schema.name in ("aten::index", "aten::index_put_"):
            for index in (one for one in args[1] if one is not None):
                assert index.device.type in ("cpu", args[0].device.type), "indexed by another device's tensor"
        return func(*args, **kwargs or {})


@pytest.mark.parametrize("task", ["weave", "pandas", "planar_arms"])
def test_many_robots_and_arms_train_on_a_device(task: str) -> None:
    flow = model_of(config.load([f"task={task}", "ablation=plus", "preset=smoke", "source.fit=false"])).to("meta")
    x_1, M = torch.zeros(8, flow.T, flow.D, device="meta"), torch.ones(8, dtype=torch.bool, device="meta")
    assume = _config.patch(meta_nonzero_assume_all_nonzero=True)  # type: ignore[attr-defined]  # "meta" cannot know
    with assume, OneDevice():  # type: ignore[no-untyped-call]  # of torch
        results = [flow.loss(x_1, M, None), flow.u_c(x_1)]  # type: ignore[arg-type]
    assert {(result.device.type, result.dtype) for result in results} == {("meta", torch.float32)}
    robots = flow.task.robots
    assert robots.pullback(x_1, robots.points(x_1)).shape == x_1.shape


def test_sampling_uses_no_autograd(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object, **__: object) -> None:
        raise AssertionError("autograd on the sampling path")

    flow = model()
    x_1 = swap(8)
    monkeypatch.setattr(torch.autograd, "grad", forbidden)
    monkeypatch.setattr(torch.autograd, "backward", forbidden)
    for setting in SETTINGS:
        assert not flow.sample(x_1, setting, noise()).requires_grad


IN_BF16 = {
    "resmlp": ["ablation=cgp"],
    "spectral": ["ablation=plus", "source.fit=false"],
    "attention": ["ablation=plus", "task=weave", "task.robots=[3]", "source.fit=false"],
}


@pytest.mark.parametrize("kind", IN_BF16)
def test_in_bf16_the_layers_round_while_training_and_nothing_else_does(kind: str) -> None:
    def made(precision: str) -> Training:
        torch.manual_seed(0)
        made = model_of(config.load(["preset=smoke", *IN_BF16[kind], f"train.precision={precision}"]))
        torch.nn.init.normal_(made.v.outlet.weight, std=0.1)
        return made

    plain, half = made("32"), made("bf16")
    x_1 = torch.rand(64, plain.T, plain.D, generator=noise()) - 0.5
    M, dtypes = torch.ones(64, dtype=torch.bool), set()
    for module in half.v.modules():
        if isinstance(module, torch.nn.Linear):
            module.register_forward_hook(lambda _, __, output: dtypes.add(output.dtype))
    assert torch.equal(half.eval().loss(x_1, M, noise()), plain.eval().loss(x_1, M, noise()))
    assert torch.equal(half.sample(x_1, "none", noise()), plain.sample(x_1, "none", noise()))
    assert dtypes == {torch.float32}
    dtypes.clear()
    seen: list[torch.dtype] = []
    half.u_c.register_forward_hook(lambda _, inputs, output: seen.extend([inputs[0].dtype, output.dtype]))
    losses = [flow.train().loss(x_1, M, noise()) for flow in (half, plain)]
    assert dtypes == {torch.bfloat16}
    assert set(seen) == {losses[0].dtype} == {torch.float32}
    rounded, exact = (
        torch.cat([g.flatten() for g in torch.autograd.grad(loss, list(flow.v.parameters()))])
        for loss, flow in zip(losses, (half, plain), strict=True)
    )
    assert not torch.equal(rounded, exact)
    # A factor of 8 bits is off by 2^-9 at most, and there are some ten layers, forward and back.
    assert (rounded - exact).norm() < 10 * 2**-8 * exact.norm()


def test_the_closed_form_is_exact_in_bf16_too() -> None:
    """Where h_theta is zero nothing is rounded, and start and goal are met to the last bit."""
    plain, half = (model(*IN_BF16["spectral"], f"train.precision={precision}").train() for precision in ("32", "bf16"))
    x_1 = swap(50)
    x_t, t = half.source.sample(half.source.observe(x_1), noise()), torch.full((50,), 0.3)
    assert torch.equal(half.v(x_t, t), plain.v(x_t, t))
    torch.nn.init.normal_(half.v.outlet.weight, std=0.1)
    assert not half.v(x_t, t)[:, [0, -1]].any()


LOSSES = [*IN_BF16.values(), ["ablation=guided_path"], ["ablation=end"], ["correction.mask=feasible"]]


@pytest.mark.parametrize("arguments", LOSSES, ids=" ".join)
def test_the_loss_of_a_batch_is_the_mean_of_its_shares_and_so_is_its_gradient(arguments: list[str]) -> None:
    """Whatever is corrected in which share: each is a mean over all of its rows, with their own x_0 and t."""
    flow = model_of(config.load(["preset=smoke", *arguments]))
    torch.nn.init.normal_(flow.v.outlet.weight, std=0.1, generator=noise())
    x_1 = torch.rand(32, flow.T, flow.D, generator=noise()) - 0.5
    M = torch.arange(32) < 5  # all in the first share
    shares = [slice(0, 8), slice(8, 16), slice(16, 24), slice(24, 32)]
    parameters = list(flow.v.parameters())
    losses = [flow.loss(x_1, M, noise(), rows) for rows in [slice(None), *shares]]
    whole, *parts = (
        torch.cat([g.flatten() for g in torch.autograd.grad(loss, parameters, allow_unused=True) if g is not None])
        for loss in losses
    )
    # Single precision adds up in another order.
    torch.testing.assert_close(torch.stack(losses[1:]).mean(), losses[0], rtol=1e-5, atol=0)
    torch.testing.assert_close(torch.stack(parts).mean(dim=0), whole, rtol=1e-4, atol=1e-6 * float(whole.abs().max()))
    assert not torch.allclose(parts[0], whole, rtol=0.01)


@pytest.mark.parametrize("ramp", [1, 3])
def test_the_correction_at_the_end_is_taken_where_the_network_says_the_path_goes(ramp: int) -> None:
    """u_t = x_1 - x_0 + lambda t^ramp S grad C(x_t + (1 - t) v), by autograd, whatever M is, v held fixed in it."""
    settings = ("correction.smoothing=covariant", "correction.margin=0.05", f"correction.ramp={ramp}")
    flow = model("correction.at=end", *settings)
    x_1, draws = swap(300), noise()
    x_0 = flow.source.sample(x_1[:, [0, -1]], draws)
    t = torch.rand(300, generator=draws)
    s = t[:, None, None]
    x_t = (1 - s) * x_0 + s * x_1
    v = flow.v(x_t, t)
    x_end = (x_t + (1 - s) * v).detach().requires_grad_()
    C = -F.softplus(-10 * ((x_end[..., :2] - x_end[..., 2:]).norm(dim=-1) - 0.35)) / 10
    (g,) = torch.autograd.grad(C.sum(), x_end)
    Sigma = flow.source.covariance
    target = x_1 - x_0 + 2.5 * s**ramp * ((Sigma / Sigma.sum(dim=1).max()).float() @ g)
    expected = ((v - target) ** 2).mean()
    for M in (torch.zeros(300, dtype=torch.bool), torch.ones(300, dtype=torch.bool)):
        # Single precision.
        assert flow.loss(x_1, M, noise()).item() == pytest.approx(expected.item(), rel=1e-5)
    # Only v in the difference is differentiated, not where the correction was taken.
    bias = flow.v.outlet.bias
    (mine,) = torch.autograd.grad(flow.loss(x_1, ~M, noise()), bias)
    (reference,) = torch.autograd.grad(expected, bias)
    torch.testing.assert_close(mine, reference, rtol=1e-4, atol=1e-6)


def test_a_feasible_prediction_is_not_corrected() -> None:
    """With the relu barrier the loss on far-away trajectories is plain flow matching's."""
    x_1 = swap(400, amplitudes=(0.05,))
    x_1[..., 1] -= 0.5
    x_1[..., 3] += 0.5
    arguments = ("correction.at=end", "constraint.barrier=relu", "network.kind=spectral", "source.modes=8")
    corrected, plain = model(*arguments), model(*arguments, "correction.lambda_c=0")
    plain.load_state_dict(corrected.state_dict())
    for flow in (corrected, plain):
        flow.fit(x_1)  # the Gaussian flow of the demonstrations predicts their mean: feasible
    M = torch.zeros(400, dtype=torch.bool)
    assert torch.equal(corrected.loss(x_1, M, noise()), plain.loss(x_1, M, noise()))


def test_the_guided_loss_regresses_the_velocity_of_the_guided_path() -> None:
    flow = model("ablation=guided_path")
    x_1, draws = swap(100), noise()
    x_0 = flow.source.sample(x_1[:, [0, -1]], draws)
    t = torch.rand(100, generator=draws)
    M = closest(x_1) < 0.3
    x_t, u_t = guided_path(x_0, x_1, t, flow.u_c, 20.0 * M)
    assert flow.loss(x_1, M, noise()).item() == pytest.approx(F.mse_loss(flow.v(x_t, t), u_t).item(), rel=1e-6)
    straight = interpolate(x_0, x_1, t)
    moved = (x_t - straight).abs().amax(dim=(1, 2)) > 1e-4
    assert not moved[~M].any()
    assert moved[M].float().mean() > 0.5


@pytest.mark.parametrize("setting", SETTINGS)
def test_plus_meets_start_and_goal_to_the_last_bit_under_every_setting(setting: str) -> None:
    x_1 = swap(200)
    flow = model("ablation=plus", "source.fit=false")
    flow.fit(x_1)
    torch.nn.init.normal_(flow.v.outlet.weight, std=0.1)
    x = flow.sample(x_1, setting, noise())
    assert torch.equal(flow.source.observe(x), flow.source.observe(x_1))


@pytest.mark.parametrize("steps", [1, 6])
def test_guidance_by_descent_takes_the_steps_that_are_asked_for(steps: int) -> None:
    flow = model("ablation=plus", "source.fit=false", f"sample.guidance_steps={steps}")
    x, t = swap(50), torch.full((50,), 0.75)
    v = flow.field("none")(x, t)
    e = x + 0.25 * v
    for _ in range(steps):
        e = e + 0.5 * flow.u_c(e)
    torch.testing.assert_close(flow.field("robot")(x, t), 4 * (e - x))
    assert not torch.equal(flow.field("robot")(x, t), v)


@pytest.mark.parametrize("t", [0.0, 0.5, 1.0])
def test_guidance_at_the_end_acts_where_its_training_does(t: float) -> None:
    """v + lambda t u^c(x + (1 - t) v): nothing at t = 0, the plain guidance at t = 1."""
    flow = model("ablation=plus", "source.fit=false", "sample.guidance=end")
    torch.nn.init.normal_(flow.v.outlet.weight, std=0.1)  # so that the predicted end is elsewhere than x
    x, times = swap(50), torch.full((50,), t)
    v, weight = flow.v(x, times), flow.config.sample.robot_weight
    pushed = t * flow.u_c(x + (1 - t) * v)
    assert bool(pushed.any()) == (t > 0)
    torch.testing.assert_close(flow.field("robot")(x, times), v + weight * pushed)


def test_the_norm_of_the_modes_weighs_each_by_its_width() -> None:
    """A residual along one mode counts sigma_1 of the leading mode over its own; with equal widths both norms agree."""
    flow = model("ablation=plus", "source.fit=false")
    plain = model("ablation=plus", "source.fit=false", "train.norm=waypoints")
    v = flow.v
    assert isinstance(v, SpectralMLP)
    u = torch.randn(3, *swap(1).shape[1:], generator=noise())
    u[:, [0, -1]] = 0  # where the source is conditioned there are no modes
    v.variance.fill_(0.2)
    free = u.shape[1] / v.modes.shape[1]  # the mean is over fewer numbers
    torch.testing.assert_close(flow.distance(u, 0 * u), free * plain.distance(u, 0 * u))
    v.variance[1] = 0.2 / 9
    along = [v.modes[:, k : k + 1].expand(1, -1, u.shape[2]) for k in (0, 1)]
    first, second = (float(flow.distance(mode, 0 * mode)) for mode in along)
    assert second == pytest.approx(3 * first, rel=1e-5)
