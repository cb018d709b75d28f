"""What holds for every config, text and geometry, on examples that hypothesis looks for. The same ones every time."""

import io
import math
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from conflow.errors import ConfigError
from conflow.flow.source import Source, rbf
from conflow.scene.constraint import Barrier
from conflow.scene.demonstrations import check, load
from conflow.scene.errors import DemonstrationError
from conflow.scene.settings import Obstacle
from conflow.scene.tasks.swap import swap
from conflow.training import config
from conflow.training.config import Config, Range
from tests.papers import keep_apart, keep_clear

some = settings(derandomize=True, deadline=None, max_examples=100, suppress_health_check=[HealthCheck.too_slow])
many = settings(some, max_examples=80)

TYPES = {key: (kind, allowed) for key, kind, allowed in config._fields()}


def values(kind: Any, allowed: Range) -> st.SearchStrategy[Any]:
    """The values that a setting of this type may take."""
    low, high = max(allowed.low, allowed.above, -1e9), min(allowed.high, 1e9)
    if get_args(kind) and type(None) in get_args(kind):
        return st.none() | values(next(part for part in get_args(kind) if part is not type(None)), allowed)
    if kind == list[float]:
        return st.lists(st.floats(low, high), min_size=1, max_size=64)
    if kind is float:
        return st.floats(low, high, exclude_min=math.isfinite(allowed.above))
    if kind is int:
        return st.integers(int(low), int(high))
    return st.booleans() if kind is bool else st.sampled_from(get_args(kind) or ["name", "on", "1e3", "☃"])


def free(key: str) -> bool:
    """Whether a setting's value does not choose a file of conf/."""
    return key not in ("ablation", "preset")


trees = st.fixed_dictionaries(
    {}, optional={key: values(kind, allowed) for key, (kind, allowed) in TYPES.items() if free(key)}
)


def loaded(arguments: list[str]) -> Config | str:
    """The config, or the line with which it is refused."""
    try:
        return config.load(arguments)
    except ConfigError as error:
        return str(error)


def assert_says(line: str, *names: str) -> None:
    """One line that begins with the name of one of these settings."""
    assert len(line.splitlines()) == 1
    assert line.startswith(tuple(f"{name}=" for name in names))
    assert "expected" in line


@many
@given(trees)
def test_a_config_is_accepted_or_refused_in_one_line_and_survives_being_written(changed: dict[str, Any]) -> None:
    """Settings in range are refused for contradicting each other alone, which names one of them."""
    arguments = [f"{key}={_text(value)}" for key, value in changed.items()]
    result = loaded(arguments)
    if isinstance(result, str):
        assert_says(result, *TYPES)
        return
    assert {key: config.flatten(result.tree())[key] for key in changed} == changed
    again = config.from_tree(yaml.safe_load(yaml.safe_dump(result.tree())))
    assert again == result
    assert again.sha() == result.sha()


def _text(value: Any) -> str:
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else str(value)


@many
@given(st.sampled_from(sorted(TYPES)), st.text(st.characters(exclude_categories=())))
def test_any_text_is_a_value_or_refused_in_one_line_with_its_setting(key: str, text: str) -> None:
    result = loaded([f"{key}={text}"])
    if isinstance(result, str):
        assert_says(result, key, "data.test_fraction")
        return
    value, (_, allowed) = config.flatten(result.tree())[key], TYPES[key]
    assert not isinstance(value, int | float) or value in allowed


numeric = [key for key, (kind, _) in TYPES.items() if kind in (int, float)]


@many
@given(st.sampled_from(numeric), st.floats() | st.integers(-(10**400), 10**400))
def test_a_number_out_of_range_is_refused_and_none_in_range_for_its_range(key: str, value: float) -> None:
    kind, allowed = TYPES[key]
    fits = value in allowed and (kind is float or isinstance(value, int))
    result = loaded([f"{key}={value!r}"])
    if isinstance(result, str):
        assert len(result.splitlines()) == 1
        assert not fits or str(allowed) not in result  # but for contradicting another setting
    else:
        assert fits


coordinates = st.floats(-1, 1, width=32)


@st.composite
def trajectories(draw: st.DrawFn, robots: int = 2) -> Tensor:
    """x (batch, T, D) inside the workspace, in float64."""
    batch, T = draw(st.integers(1, 3)), draw(st.integers(2, 6))
    count = batch * T * robots * 2
    return torch.tensor(draw(st.lists(coordinates, min_size=count, max_size=count))).double().view(batch, T, -1)


def turned(x: Tensor, angle: float, shift: Tensor) -> Tensor:
    """Trajectories turned about the origin and moved."""
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, -s], [s, c]], dtype=x.dtype)
    return (x.unflatten(2, (-1, 2)) @ rotation.mT + shift).flatten(2)


ROUNDING = 1e-6  # the radius is in single precision


@some
@given(trajectories(3), st.floats(-4, 4), st.floats(-1, 1), st.floats(-1, 1), st.permutations(range(3)))
def test_clearance_knows_neither_place_nor_direction_nor_whose_turn_it_is(
    x: Tensor, angle: float, right: float, up: float, order: list[int]
) -> None:
    avoidance = keep_apart(3, 0.3)
    c = avoidance.clearance(x)
    moved = turned(x, angle, torch.tensor([right, up], dtype=x.dtype))
    torch.testing.assert_close(avoidance.clearance(moved), c, rtol=0, atol=ROUNDING)
    exchanged = x.unflatten(2, (3, 2))[:, :, order].flatten(2)
    torch.testing.assert_close(avoidance.clearance(exchanged), c, rtol=0, atol=ROUNDING)
    torch.testing.assert_close(avoidance.clearance(x.flip(1)).flip(1), c, rtol=0, atol=ROUNDING)


@some
@given(trajectories(), st.floats(0.05, 1), st.floats(-1, 1), st.floats(-1, 1))
def test_clearance_is_the_gap_between_discs(x: Tensor, radius: float, right: float, up: float) -> None:
    robots = keep_apart(2, radius).clearance(x)
    obstacle = keep_clear(2, [Obstacle(right, up, radius)], 0.15).clearance(x)
    for b, path in enumerate(x.tolist()):
        for i, (x1, y1, x2, y2) in enumerate(path):
            assert math.isclose(robots[b, i], math.hypot(x1 - x2, y1 - y2) - radius, abs_tol=ROUNDING)
            nearest = min(math.hypot(x1 - right, y1 - up), math.hypot(x2 - right, y2 - up))
            assert math.isclose(obstacle[b, i], nearest - radius - 0.15, abs_tol=ROUNDING)


@some
@given(trajectories())
def test_swept_clearance_is_the_smallest_of_the_way_between(x: Tensor) -> None:
    """Never above what any point between the waypoints has, and nearly reached by one of a hundred."""
    avoidance = keep_apart(2, 0.3)
    share = torch.linspace(0, 1, 101, dtype=x.dtype)[:, None, None, None]
    between = torch.stack([avoidance.clearance(y) for y in torch.lerp(x[:, :-1], x[:, 1:], share)]).amin(dim=0)
    swept = avoidance.swept_clearance(x)
    assert bool((swept <= between + ROUNDING).all())
    # Half a step of 1/100 of a separation's change, which is at most 4 sqrt(2).
    assert bool((between - swept <= 4 * 2**0.5 / 200 + ROUNDING).all())


@some
@given(trajectories(), st.integers(0, 99), st.sampled_from(["softplus", "relu"]), st.sampled_from(["sum", "mean"]))
def test_the_barrier_is_at_most_zero_and_its_gradient_leads_out(
    x: Tensor, seed: int, shape: Any, reduction: Any
) -> None:
    """Along the gradient C does not fall, and no step of length h changes a clearance by more than sqrt(2) h."""
    avoidance = keep_apart(2, 0.3, Barrier(shape, reduction))
    c, C, g = avoidance.clearance(x), avoidance.barrier(x), avoidance.gradient(x)
    assert bool((C <= 0).all())
    assert bool(g.isfinite().all())
    # Where the robots are 0.01 apart or more, so that a step this small does not take one through the other.
    apart = (c > -0.29).all(dim=1)
    assert bool((avoidance.barrier(x + 1e-5 * g) >= C - 1e-9)[apart].all())
    step = 0.1 * torch.randn(x.shape, dtype=x.dtype, generator=torch.Generator().manual_seed(seed))
    change = (avoidance.clearance(x + step) - c).abs()
    assert bool((change <= 2**0.5 * step.norm(dim=2) + ROUNDING).all())


@some
@given(trajectories(), st.sampled_from([math.nan, math.inf, -math.inf]), st.data())
def test_what_is_no_number_violates(x: Tensor, value: float, data: st.DataObject) -> None:
    avoidance = keep_apart(2, 0.3)
    x.view(-1)[data.draw(st.integers(0, x.numel() - 1))] = value
    c = avoidance.clearance(x)
    assert bool(avoidance.violation(x)[~c.isfinite().all(dim=1) & c.isnan().any(dim=1)].all())


@some
@given(
    st.integers(1, 30), st.integers(3, 40), st.lists(st.floats(0, 0.2), min_size=1, max_size=5), st.integers(0, 2**32)
)
def test_swaps_are_demonstrations(num: int, T: int, amplitudes: list[float], seed: int) -> None:
    """Inside the workspace wherever the amplitudes leave them, from side to side, and a function of the seed."""
    x = swap(num, T, amplitudes, 0.04, seed)
    check(x, "swaps")
    assert x.shape == (num, T, 4)
    ends = torch.tensor([[-0.8, 0, 0.8, 0], [0.8, 0, -0.8, 0]])
    assert bool(((x[:, [0, -1]] - ends).abs() <= 0.04 + 1e-6).all())
    assert torch.equal(x, swap(num, T, amplitudes, 0.04, seed))


@some
@given(st.integers(3, 24), st.data())
def test_a_source_meets_whatever_it_is_conditioned_on(T: int, data: st.DataObject) -> None:
    index = data.draw(st.lists(st.integers(0, T - 1), unique=True, max_size=T))
    length_scale = data.draw(st.floats(0.01, 10))
    source = Source(rbf(T, length_scale, 1.0, 1e-6), index)
    y = torch.randn(3, len(index), 2, generator=torch.Generator().manual_seed(0))
    assert torch.equal(source.observe(source.sample(y, torch.Generator().manual_seed(1))), y)


@settings(some, suppress_health_check=[HealthCheck.function_scoped_fixture])  # each example overwrites the file
@given(content=st.binary(max_size=200))
def test_any_bytes_are_demonstrations_or_refused(content: bytes, tmp_path: Path) -> None:
    """Also behind a true beginning."""
    path = tmp_path / "any.npz"
    file = io.BytesIO()
    np.savez(file, x=swap(3).numpy())
    whole = file.getvalue()
    for start in (b"", b"PK\x03\x04", b"\x93NUMPY\x01\x00", whole[:200]):
        path.write_bytes(start + content)
        with suppress(DemonstrationError):  # the one thing that may be raised
            load(path)
