"""Demonstrations of other kinds: passing and the social-force planner, the file they are written to, the command."""

import errno
import os
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from conflow.flow.source import cgp, fit_rbf
from conflow.scene.demonstrations import Demonstrations, check, digest, load, save
from conflow.scene.errors import DemonstrationError
from conflow.scene.measures import smoothness
from conflow.scene.tasks import TASKS
from conflow.scene.tasks.curves import SIDES
from conflow.scene.tasks.passing import passing
from conflow.scene.tasks.planar_arms import PlanarArms
from conflow.scene.tasks.social import social
from conflow.scene.tasks.social_force import Robots, walk
from conflow.scene.tasks.swap import swap
from conflow.training import config
from conflow.training.datamodule import DemonstrationData
from tests.conftest import Typed
from tests.papers import TWO


def nearest(x: Tensor) -> Tensor:
    """The robots' smallest distance over waypoints of x (num, T, 4), (num,)."""
    return (x[..., :2] - x[..., 2:]).norm(dim=2).amin(dim=1)


def along_and_across(x: Tensor) -> tuple[Tensor, Tensor]:
    """Progress from 0 to 1 along each robot's straight line, and deviation to its left, (num, 2, T) each."""
    paths = x.double().unflatten(2, (2, 2)).transpose(1, 2)
    travel = paths[:, :, -1:] - paths[:, :, :1]
    off, length = paths - paths[:, :, :1], travel.norm(dim=3)
    left = torch.stack([-travel[..., 1], travel[..., 0]], dim=-1)
    return (off * travel).sum(dim=3) / length**2, (off * left).sum(dim=3) / length


@pytest.mark.parametrize(
    ("num", "T", "seed", "radius"),
    [(3000, 32, 0, 0.3), (3000, 32, 1, 0.3), (30_000, 32, 2, 0.3), (3000, 24, 3, 0.3), (3000, 64, 4, 0.4)],
)
def test_forty_percent_collide_and_the_others_pass_barely_outside(num: int, T: int, seed: int, radius: float) -> None:
    """Of the smallest distances 40 % lie below the radius, 60 % uniformly in [radius, 1.2 radius], none at it."""
    distance = nearest(passing(num, T, seed, radius))
    collides = distance < radius
    assert int(collides.sum()) == round(0.4 * num)
    # 1e-3 away, but for float32 rounding
    assert float((distance - radius).abs().min()) > 0.999e-3
    share = (distance[~collides] - radius) / (0.2 * radius)
    assert float(share.max()) < 1 + 1e-5
    # Quantiles of 1800 uniform draws and more: four standard errors are at most 0.047.
    levels = torch.tensor([0.1, 0.25, 0.5, 0.75, 0.9])
    torch.testing.assert_close(share.quantile(levels), levels, rtol=0, atol=0.06)
    # From the straight lines' distances, of which most are below a third of the radius, evenly up to the radius.
    below = distance[collides] / radius
    assert float(below.min()) < 0.1
    assert 0.5 < float(below.median()) < 0.65
    assert float(below.max()) > 0.98


def assert_from_side_to_side(x: Tensor) -> None:
    """All start and end within the jitter of the sides, and some of many near its limits."""
    sides = torch.tensor(SIDES)
    for ends, nominal in ((x[:, 0], sides), (x[:, -1], sides.flip(0))):
        off = (ends.unflatten(1, (2, 2)) - nominal).abs()
        # float32 rounding of a coordinate below 1; 3000 draws miss 1 % of their range but for a chance of 1e-12
        assert bool((off <= 0.04 + 1e-7).all())
        assert bool((off.amax(dim=0) > 0.99 * 0.04).all())


def test_they_are_demonstrations_as_good_as_swaps() -> None:
    """Inside the workspace, finite, in float32, with starts and goals at the jittered sides, and about as smooth."""
    x = passing(5000)
    assert x.dtype == torch.float32
    assert x.shape == (5000, 32, 4)
    check(x, "generated")
    assert_from_side_to_side(x)
    ratio = smoothness(TWO, x).quantile(0.5) / smoothness(TWO, swap(5000)).quantile(0.5)
    assert 1 / 2 < float(ratio) < 2


def test_the_ends_do_not_depend_on_the_bulge() -> None:
    """Of any bulge, starts and goals are the same to the last bit, and next to them the path is straight."""
    x, wider = passing(1000, radius=0.3), passing(1000, radius=0.4)
    assert torch.equal(x[:, [0, -1]], wider[:, [0, -1]])
    assert float((x - wider).abs().amax()) > 0.05
    progress, deviation = along_and_across(x)
    # float32 rounding
    assert float(deviation[(progress < 0.02) | (progress > 0.98)].abs().max()) < 3e-7


def test_progress_is_monotone_and_speed_varies_by_robot_and_trajectory() -> None:
    """The speed along the line stays between 0.2 and 1.8 of its mean, and mostly changes by half of it or more."""
    progress, _ = along_and_across(passing(3000))
    speed = progress.diff(dim=2) * 31
    assert float(speed.min()) > 0.2
    assert float(speed.max()) < 1.8
    ratio = speed.amax(dim=2) / speed.amin(dim=2)
    assert float((ratio > 1.5).double().mean()) > 0.7
    # At half-time progress is 1/2 +- (0.3 - 0.1 / 3) / pi at random, in either robot for itself.
    half = (progress[:, :, 15] + progress[:, :, 16]) / 2
    assert float(half.std()) == pytest.approx(((0.3**2 + (0.1 / 3) ** 2) / 3) ** 0.5 / torch.pi, rel=0.05)
    assert abs(float(torch.corrcoef(half.mT)[0, 1])) < 4 / 3000**0.5


def test_the_bulge_is_a_raised_cosine_where_the_robots_pass() -> None:
    """|deviation| = height (1 + cos(pi (s - c) / w)) / 2, w in [0.25, 0.35], c where the straight lines come closest.

    The two heights are shares in [0.3, 0.7] of their sum, to the right of travel for 65 %, independently of collision.
    """
    x = passing(5000, seed=1)
    s, deviation = along_and_across(x)
    height, where = deviation.abs().max(dim=2)
    assert torch.equal(where[:, 0], where[:, 1])
    p, q = x.double()[:, :1], x.double()[:, -1:]
    line = p + s.transpose(1, 2).repeat_interleave(2, dim=2) * (q - p)
    closest = (line[..., :2] - line[..., 2:]).norm(dim=2).argmin(dim=1)
    tall = (height > 0.02).all(dim=1)
    assert torch.equal(where[tall, 0], closest[tall])

    c = s.take_along_dim(where[..., None], dim=2)
    value = deviation.abs() / height[..., None]
    w = torch.pi * (s - c).abs() / torch.acos((2 * value - 1).clamp(-1, 1))
    flank = (value > 0.1) & (value < 0.9) & tall[:, None, None]
    # float32 rounding of 1e-7 in a height of 0.02 and more, of which the arc cosine makes threefold
    assert float(w[flank].min()) > 0.25 - 1e-4
    assert float(w[flank].max()) < 0.35 + 1e-4
    assert float(w[flank].max() - w[flank].min()) > 0.099
    assert float((w.where(flank, 0.0).amax(dim=2) - w.where(flank, 1.0).amin(dim=2)).max()) < 1e-4

    share = (height / height.sum(dim=1, keepdim=True))[tall]
    assert 0.3 - 1e-5 < float(share.min()) < 0.302
    right = deviation.take_along_dim(where[..., None], dim=2)[..., 0] < 0
    assert torch.equal(right[:, 0], right[:, 1])
    assert int(right[:, 0].sum()) == 3250
    # Four standard errors
    assert float(right[nearest(x) < 0.3, 0].double().mean()) == pytest.approx(0.65, abs=4 * (0.65 * 0.35 / 2000) ** 0.5)


@pytest.mark.parametrize("kind", TASKS)
def test_a_seed_is_a_data_set(kind: str) -> None:
    """The same seed gives the same bytes, whatever happens to the global generator; another one differs."""
    x = TASKS[kind]().demonstrations(50, seed=7)
    torch.manual_seed(0)
    again, other = (TASKS[kind]().demonstrations(50, seed) for seed in (7, 8))
    assert isinstance(x, Tensor)
    assert isinstance(again, Tensor)
    assert isinstance(other, Tensor)
    assert digest(again) == digest(x)
    assert not bool((other[:, 0] == x[:, 0]).all(dim=1).any())


@pytest.mark.parametrize("seed", range(4))
def test_of_social_robots_some_collide_and_the_others_pass_barely_outside(seed: int) -> None:
    """38 % collide; the median distance of the others is within a quarter of the radius, and no label on the edge."""
    x = social(3000, seed=seed)
    distance = nearest(x)
    collides = distance < 0.3
    # Of 37.9 % over 20 seeds, four standard errors of 3000 draws
    assert float(collides.double().mean()) == pytest.approx(0.379, abs=4 * (0.38 * 0.62 / 3000) ** 0.5)
    assert float((distance - 0.3).abs().min()) > 0.999e-3
    assert 1.05 < float(distance[~collides].median()) / 0.3 < 1.25
    assert float(distance[~collides].quantile(0.95)) / 0.3 < 1.6
    assert 0.5 < float(distance[collides].quantile(0.05)) / 0.3 < float(distance[collides].median()) / 0.3 < 0.95


def test_social_robots_are_demonstrations_that_accelerate_and_brake() -> None:
    """Inside the workspace, in float32, from and to the jittered sides, and far less smooth than the swap."""
    x = social(3000)
    assert x.dtype == torch.float32
    assert x.shape == (3000, 32, 4)
    check(x, "generated")
    assert_from_side_to_side(x)
    feasible = smoothness(TWO, x[nearest(x) > 0.3])
    assert 0.006 < float(feasible.quantile(0.05)) < float(feasible.quantile(0.95)) < 0.02
    assert float(feasible.median()) > 2.5 * float(smoothness(TWO, swap(3000)).median())


def test_what_social_robots_do_is_not_in_the_leading_modes() -> None:
    """Of the variance about the fitted source's mean a tenth of a percent lies beyond its 8 modes, of the swap none."""

    def beyond(x: Tensor) -> float:
        source = cgp(32, *fit_rbf(x, (0, -1)))
        residual = x.double() - source.mean(source.observe(x.double()))
        held = torch.einsum("tm,ntd->nmd", source.modes[:, :8], residual)
        return 1 - float(held.square().sum() / residual.square().sum())

    assert beyond(swap(2000)) < 1e-9
    assert beyond(social(2000)) > 5e-4


def test_more_social_robots_begin_with_the_same_ones() -> None:
    """Whatever is drawn again, and in how many portions."""
    assert torch.equal(social(2500, seed=5)[:30], social(30, seed=5))


def pairs(num: int, **habits: float) -> Robots:
    """Pairs of robots that swap sides, with random habits in float64 but for those given."""
    generator = torch.Generator().manual_seed(0)

    def between(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(num, 2, generator=generator, dtype=torch.float64)

    sides = torch.tensor(SIDES, dtype=torch.float64)
    robots = Robots(
        start=sides + torch.stack([between(-0.04, 0.04), between(-0.04, 0.04)], dim=2),
        goal=sides.flip(0) + torch.stack([between(-0.04, 0.04), between(-0.04, 0.04)], dim=2),
        speed=between(0.5, 1),
        drift=between(-0.1, 0.1),
        repulsion=between(0, 10),
        reach=between(0.05, 0.1),
        sidestep=between(-5, 5),
        sight=between(0.3, 0.5),
    )
    return robots._replace(**{name: torch.full_like(robots.speed, value) for name, value in habits.items()})


def test_a_walk_does_not_depend_on_the_batch_or_the_threads() -> None:
    """To the last bit: a part of the pairs in another order, and two threads."""
    robots = pairs(1000)
    x, arrival = walk(robots, 32, 0.3)
    some = torch.randperm(1000, generator=torch.Generator().manual_seed(0))[:101]
    part = walk(Robots(*(habit[some] for habit in robots)), 32, 0.3)
    torch.testing.assert_close(part, (x[some], arrival[some]), rtol=0, atol=0, equal_nan=True)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        torch.testing.assert_close(walk(robots, 32, 0.3), (x, arrival), rtol=0, atol=0, equal_nan=True)
    finally:
        torch.set_num_threads(threads)


def test_a_walk_has_the_symmetries_of_the_plane() -> None:
    """A mirror image of pairs walks the mirror image, a rotated one the rotated, and the robots can be exchanged."""
    robots = pairs(200)
    x, arrival = walk(robots, 32, 0.3)
    mirror = torch.tensor([1.0, -1.0], dtype=torch.float64)
    image = robots._replace(
        start=robots.start * mirror, goal=robots.goal * mirror, drift=-robots.drift, sidestep=-robots.sidestep
    )
    assert torch.equal(walk(image, 32, 0.3)[0], x * mirror.repeat(2))
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.7], [0.7, 0.0]], dtype=torch.float64))
    turned = robots._replace(start=robots.start @ turn.mT, goal=robots.goal @ turn.mT)
    expected = (x.unflatten(2, (2, 2)) @ turn.mT).flatten(2)
    # float64 rounding, which a head-on encounter magnifies
    torch.testing.assert_close(walk(turned, 32, 0.3)[0], expected, rtol=0, atol=1e-6)
    exchanged = walk(Robots(*(habit.flip(1) for habit in robots)), 32, 0.3)
    assert torch.equal(exchanged[0], x.roll(2, dims=2))
    assert torch.equal(exchanged[1], arrival.flip(1))


def test_robots_that_feel_nothing_walk_straight_at_their_speed() -> None:
    """Progress is monotone and begins at rest; before they brake, the two have a ratio of the desired speeds."""
    robots = pairs(200, repulsion=0.0, sidestep=0.0, drift=0.0)
    x, _ = walk(robots, 400, 0.3)
    progress, deviation = along_and_across(x)
    assert float(deviation.abs().max()) < 1e-12
    step = progress.diff(dim=2)
    assert float(step.min()) > -1e-12
    # The last step to the goal is another.
    top = step.where(progress[..., 1:] < 0.9, 0.0).amax(dim=2)
    ratio = (top * (robots.goal - robots.start).norm(dim=2)).unbind(dim=1)
    # They brake within 0.6 of the goal; after 0.9 and more the fastest has approached its speed to exp(-0.9 / 0.2).
    torch.testing.assert_close(ratio[0] / ratio[1], robots.speed[:, 0] / robots.speed[:, 1], rtol=0.015, atol=0)
    assert bool((step[..., 0] < 0.2 * top).all())


def test_who_has_arrived_stays_and_the_later_one_ends_the_walk() -> None:
    robots = pairs(500)
    x, arrival = walk(robots, 64, 0.3)
    assert torch.equal(x[:, 0], robots.start.flatten(1))
    assert torch.equal(x[:, -1], robots.goal.flatten(1))
    assert torch.equal(arrival.amax(dim=1), torch.ones(500, dtype=torch.float64))
    there = torch.linspace(0, 1, 64, dtype=torch.float64) > arrival[..., None]
    at_goal = (x.unflatten(2, (2, 2)).transpose(1, 2) == robots.goal[:, :, None]).all(dim=3)
    assert bool(at_goal[there].all())
    # A waypoint before, it is not
    assert not bool(at_goal[torch.linspace(0, 1, 64, dtype=torch.float64) < arrival[..., None] - 1 / 63].any())
    early = 1 - arrival.amin(dim=1)
    assert float(early.quantile(0.25)) > 0.04
    assert float(early.quantile(0.75)) > 0.15


def test_a_robot_that_does_not_arrive_spoils_its_own_pair_alone() -> None:
    robots = pairs(3)
    slow = robots._replace(speed=robots.speed.index_fill(0, torch.tensor([1]), 0.05))
    x, arrival = walk(slow, 32, 0.3)
    assert bool(x[1].isnan().all())
    assert bool(arrival[1].isnan().all())
    assert torch.equal(x[[0, 2]], walk(robots, 32, 0.3)[0][[0, 2]])


def test_stronger_forces_keep_robots_apart_on_the_side_that_they_prefer() -> None:
    """Without forces all collide; repulsion and sidestep each widen the median distance; both step to their right."""

    def median(repulsion: float, sidestep: float) -> float:
        return float(nearest(walk(pairs(500, repulsion=repulsion, sidestep=sidestep), 32, 0.3)[0]).median())

    assert float(nearest(walk(pairs(500, repulsion=0.0, sidestep=0.0), 32, 0.3)[0]).max()) < 0.3
    assert median(0, 0) < median(0, 2) < median(0, 4)
    assert median(0, 2) < median(4, 2) < median(8, 2)

    for sidestep in (-4.0, 4.0):
        x, _ = walk(pairs(500, repulsion=4.0, sidestep=sidestep), 32, 0.3)
        where = (x[..., :2] - x[..., 2:]).norm(dim=2).argmin(dim=1)
        _, deviation = along_and_across(x)
        beside = deviation.take_along_dim(where[:, None, None], dim=2).sum(dim=1) * sidestep
        assert float((beside > 0).double().mean()) > 0.99


@pytest.mark.parametrize(("T", "radius"), [(4, 0.3), (32, 0.05)])
def test_what_cannot_be_had_is_refused(T: int, radius: float) -> None:
    """Where not even straight lines collide at a waypoint, no 40 % can."""
    with pytest.raises(DemonstrationError, match=f"^radius={radius}: straight lines keep a distance .* expected less"):
        passing(1000, T, radius=radius)


def test_people_who_cannot_arrive_are_refused() -> None:
    """They were drawn for ever."""
    with pytest.raises(DemonstrationError, match=r"^radius=1\.8: 0 of 1000 pairs arrive inside, expected less$"):
        social(100, radius=1.8)


def test_a_file_is_read_back_to_the_last_bit_and_trained_on(tmp_path: Path) -> None:
    """`load` finds x and no labels, so the experiment computes them: 40 % violate its own threshold."""
    path = tmp_path / "passing.npz"
    x = passing(500)
    save(path, Demonstrations(x))
    loaded = load(path)
    assert torch.equal(loaded.x, x)
    assert loaded.violates is None
    data = DemonstrationData(config.load(["preset=smoke", f"data.path={path}"]))
    assert torch.equal(data.violates, nearest(x) < 0.3)
    assert int(data.violates.sum()) == 200


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When the disk is full half-way, neither the file nor a part of it stays."""

    def full(path: Path, **arrays: Any) -> None:
        path.write_bytes(b"PK")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(DemonstrationError, match=r"passing.npz: No space left on device, expected a new file"):
        save(tmp_path / "passing.npz", Demonstrations(passing(10)))
    assert not list(tmp_path.iterdir())


@pytest.fixture
def demonstrations(in_process: Typed) -> Typed:
    """`python -m conflow demonstrations ...` in an empty folder."""
    return partial(in_process, "demonstrations")


@pytest.mark.parametrize(
    ("arguments", "name", "written"),
    [
        ((), "swap.npz", swap(3000)),
        (("task=passing", "out=other.npz", "num=50", "seed=3"), "other.npz", passing(50, seed=3)),
        (("task=social", "num=50"), "social.npz", social(50)),
        (("task=social", "out=other.npz", "num=50", "seed=3"), "other.npz", social(50, seed=3)),
        (("task=planar_arms", "num=10"), "planar_arms.npz", PlanarArms().demonstrations(10, 0)),
    ],
    ids=["defaults", "passing", "social", "social elsewhere", "arms"],
)
def test_the_command_writes_what_it_says(
    arguments: tuple[str, ...], name: str, written: Tensor, demonstrations: Typed
) -> None:
    code, out, err = demonstrations(*arguments)
    task = "".join(f"TASK={one.removeprefix('task=')} " for one in arguments if one.startswith("task="))
    assert (code, err) == (0, "")
    assert out == f"Written: {name}; train on it with: make train {task}ARGS=data.path={name}\n"
    assert [path.name for path in Path().iterdir()] == [name]
    assert torch.equal(load(name).x, written)


def test_the_command_never_overwrites(demonstrations: Typed) -> None:
    Path("passing.npz").write_text("precious")
    code, out, err = demonstrations("task=passing", "num=10")
    assert (code, out) == (2, "")
    assert err == "conflow: out=passing.npz: File exists, expected a new file in an existing folder\n"
    assert [path.name for path in Path().iterdir()] == ["passing.npz"]
    assert Path("passing.npz").read_text() == "precious"


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("out=no/passing.npz", "out=no/passing.npz: No such file or directory, expected a new file in an existing fol"),
        ("out=passing.csv", "out=passing.csv: expected a name that ends in .npz"),
        (f"out={'a' * 300}.npz", f"out={'a' * 300}.npz: File name too long, expected"),
        ("task=socal", "task=socal: expected one of basic, circle, conveyor, dense, highways, pandas, passing, "),
        ("task=", "task=: expected one of basic, circle, conveyor, dense, highways, pandas, passing, "),
        ("num=9", "num=9: expected a whole number of at least 10 and at most 100000"),
        ("num=many", "num=many: expected a whole number"),
        ("seed=-1", "seed=-1: expected a whole number of at least 0"),
        (
            "sed=1",
            "sed: no such option, expected task, from, out, num, seed, agents, seconds, T, fps, opposite, near; did",
        ),
        ("passing.npz", "passing.npz: expected key=value"),
    ],
)
def test_a_bad_command_ends_in_one_line_and_writes_nothing(argument: str, said: str, demonstrations: Typed) -> None:
    code, out, err = demonstrations("num=10", argument)
    assert (code, out) == (2, "")
    assert err.startswith(f"conflow: {said}")
    assert err.count("\n") == 1
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ("demonstrations", "OUT=a b.npz", "NUM=50", "SEED=3"),
            ["demonstrations", "task=swap", "out=a b.npz", "num=50", "seed=3"],
        ),
        (("demonstrations", "TASK=social"), ["demonstrations", "task=social", "seed=0"]),
        (("demonstrations", "FROM=a.csv"), ["demonstrations", "from=a.csv", "seed=0"]),
        (("demonstrations",), ["demonstrations", "task=swap", "seed=0"]),
        (("sample", "OUT=a.npz", "NUM=7"), ["sample", "run=latest", "start=", "goal=", "out=a.npz", "num=7", "seed=0"]),
        (("sample",), ["sample", "run=latest", "start=", "goal=", "seed=0"]),
        (("planbench",), ["planbench", "n=", "scenes=64", "format=table"]),
        (
            ("planbench", "TASK=room", "N=9", "RUN=latest", "SEED=0", "OUT=here", "NUM=4"),
            [
                *("planbench", "task=room", "n=9", "scenes=64", "format=table"),
                *("run=latest", "seed=0", "out=here", "num=4"),
            ],
        ),
        (("sample", "RUN=none"), ["sample", "task=swap", "run=none", "start=", "goal=", "seed=0"]),
    ],
)
def test_make_passes_on_what_is_given(arguments: tuple[str, ...], expected: list[str]) -> None:
    """Without OUT and NUM the command's own defaults hold. The command is echoed instead of run."""
    command = ["make", "--silent", "--old-file=.venv/installed", "CONFLOW=printf '%s\\n'", *arguments]
    # Not the variables of a `make test` around this.
    environment = {"PATH": os.environ["PATH"]}
    finished = subprocess.run(
        command, cwd=config.CONF.parent, env=environment, capture_output=True, text=True, check=True, timeout=60
    )
    assert finished.stdout.splitlines() == expected
