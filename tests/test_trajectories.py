"""Demonstrations: the generated swap, files, and what makes trajectories valid."""

import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from conflow.scene.demonstrations import Demonstrations, check, digest, load, save
from conflow.scene.errors import DemonstrationError
from conflow.scene.tasks.curves import SIDES
from conflow.scene.tasks.swap import Swap, swap
from tests.papers import keep_apart


@pytest.mark.parametrize(("num", "seed"), [(10_000, 0), (10_000, 1), (10_000, 2), (200_000, 3)])
def test_thirty_percent_of_the_demonstrations_collide(num: int, seed: int) -> None:
    """M is true for 30 % of the default demonstrations at the paper's threshold 0.3."""
    rate = keep_apart(2, 0.3).violation(swap(num, seed=seed)).double().mean()
    # Four standard errors of a rate of 0.3 (1.8 points of 10,000), and 0.2 points for the amplitudes' last digit.
    assert float(rate) == pytest.approx(0.3, abs=4 * math.sqrt(0.3 * 0.7 / num) + 0.002)


def test_the_demonstrations_stay_inside_the_workspace() -> None:
    """Among 50,000 none leaves [-1, 1], and the widest use most of it."""
    x = swap(50_000)
    check(x, "generated")
    assert float(x.abs().max()) > 0.95


def test_the_robots_swap_sides() -> None:
    """Starts and goals are the nominal sides, the other robot's for the goal, each jittered by up to 0.04."""
    jitter = 0.04
    x = swap(2000, jitter=jitter).view(2000, 32, 2, 2)
    sides = torch.tensor(SIDES)
    for ends, nominal in ((x[:, 0], sides), (x[:, -1], sides.flip(0))):
        off = ends - nominal
        # float32 rounding of a coordinate below 1
        assert bool((off.abs() <= jitter + 1e-7).all())
        # 2000 uniform draws come this close to both bounds but for a chance of 1e-8.
        assert bool((off.amax(dim=0) > 0.99 * jitter).all())
        assert bool((off.amin(dim=0) < -0.99 * jitter).all())


def test_without_jitter_the_ends_are_the_sides_to_the_last_bit() -> None:
    """The harmonics vanish at both ends exactly, although sin(k pi) in floating point does not."""
    x = swap(100, jitter=0.0).view(100, 32, 2, 2)
    assert torch.equal(x[:, 0], torch.tensor(SIDES).expand(100, 2, 2))
    assert torch.equal(x[:, -1], torch.tensor(SIDES).flip(0).expand(100, 2, 2))


def test_the_deviation_is_orthogonal_to_travel_and_made_of_the_harmonics() -> None:
    """x(s) - line(s) = n sum_k a_k sin(k pi s) with unit n orthogonal to q - p and |a_k| up to the amplitudes."""
    amplitudes = (0.6, 0.2, 0.05)
    x = swap(2000, T=24, amplitudes=amplitudes, seed=1).view(2000, 24, 2, 2).transpose(1, 2).double()
    s = torch.linspace(0, 1, 24, dtype=torch.float64)
    p, q = x[:, :, :1], x[:, :, -1:]
    deviation = x - (p + s[:, None] * (q - p))
    travel = (q - p) / torch.linalg.vector_norm(q - p, dim=-1, keepdim=True)
    # float32 rounding of coordinates below 1, a few times, here and below
    assert float((deviation * travel).sum(-1).abs().max()) < 5e-7
    normal = torch.stack([-travel[..., 1], travel[..., 0]], dim=-1)
    harmonics = torch.sin(torch.pi * torch.arange(1, 4)[:, None] * s)
    height = (deviation * normal).sum(-1)
    a = torch.linalg.lstsq(harmonics.mT, height.flatten(0, 1).mT).solution
    assert float((harmonics.mT @ a - height.flatten(0, 1).mT).abs().max()) < 5e-7
    # 4000 uniform draws come this close to their bound but for a chance of 1e-17.
    largest = a.abs().amax(dim=1) / torch.tensor(amplitudes)
    assert bool(((largest > 0.99) & (largest < 1 + 1e-5)).all())


def test_robots_without_deviation_meet_in_the_middle() -> None:
    """With no amplitude and no jitter each robot goes straight, and the two meet half-way."""
    x = swap(1, T=33, amplitudes=(), jitter=0.0).view(33, 2, 2)
    line = torch.linspace(-0.8, 0.8, 33)
    torch.testing.assert_close(x[:, 0, 0], line, rtol=0, atol=1e-7)  # float32 rounding
    torch.testing.assert_close(x[:, 1, 0], -line, rtol=0, atol=1e-7)
    assert torch.equal(x[..., 1], torch.zeros(33, 2))
    assert float((x[16, 0] - x[16, 1]).abs().max()) < 1e-7


def test_a_seed_is_a_data_set() -> None:
    """The same seed gives the same bytes and digest, whatever happens to the global generator; another one differs."""
    x = swap(50, seed=7)
    torch.manual_seed(0)
    assert torch.equal(swap(50, seed=7), x)
    assert digest(swap(50, seed=7)) == digest(x)
    assert not bool((swap(50, seed=8)[:, 0] == x[:, 0]).any())


def test_the_digest_tells_any_two_data_sets_apart() -> None:
    """It follows the numbers, the shape and the labels, down to one bit, and not the layout in memory."""
    x = swap(10)
    changed = x.clone()
    changed[3, 4, 1] = torch.nextafter(changed[3, 4, 1], torch.tensor(2.0))
    assert len({digest(x), digest(changed), digest(x.view(20, 16, 4)), digest(x[:9]), digest(x.flip(0))}) == 5
    labels = torch.arange(10) % 2 == 0
    assert len({digest(x), digest(x, labels), digest(x, ~labels), digest(changed, labels)}) == 4
    assert digest(x.transpose(0, 1).contiguous().transpose(0, 1)) == digest(x)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("kind", [np.float32, np.float64, ">f4"])
@pytest.mark.parametrize("labelled", [True, False])
def test_a_file_gives_back_what_was_saved(
    tmp_path: Path, save: Callable[..., None], kind: str | type[np.floating[Any]], labelled: bool
) -> None:
    """x arrives in float32, the labels where there are any; other arrays of the file are ignored."""
    x = swap(5)
    labels = {"violates": np.array([True, False, False, True, False])} if labelled else {}
    save(tmp_path / "demonstrations.npz", x=x.numpy().astype(kind), other=np.array(["note"]), **labels)
    loaded = load(tmp_path / "demonstrations.npz")
    assert torch.equal(loaded.x, x)
    assert (loaded.violates is None) == (not labelled)
    if loaded.violates is not None:
        assert loaded.violates.tolist() == [True, False, False, True, False]


def text(path: Path) -> None:
    path.write_text("x\n1.0\n")


def empty(path: Path) -> None:
    path.touch()


def folder(path: Path) -> None:
    path.mkdir()


def single_array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, swap(3).numpy())


def truncated(path: Path) -> None:
    np.savez(path, x=swap(3).numpy())
    path.write_bytes(path.read_bytes()[:600])


def corrupt(path: Path) -> None:
    np.savez_compressed(path, x=swap(50).numpy())
    content = bytearray(path.read_bytes())
    content[100:140] = b"\xff" * 40  # no deflate block begins like this
    path.write_bytes(content)


def flipped(path: Path) -> None:
    np.savez(path, x=swap(50).numpy())
    content = bytearray(path.read_bytes())
    content[1000] ^= 1  # the checksum no longer fits
    path.write_bytes(content)


def encrypted(path: Path) -> None:
    np.savez(path, x=swap(3).numpy())
    content = bytearray(path.read_bytes())
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(signature) + flags] |= 1
    path.write_bytes(content)


def broken_header(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("x.npy", b"\x93NUMPY\x01\x00\x10\x00{'descr': '<f4', ")


def pickled(path: Path) -> None:
    np.savez(path, x=np.array([[1.0], [1.0, 2.0]], dtype=object))


def without_x(path: Path) -> None:
    np.savez(path, y=swap(3).numpy())


def integers(path: Path) -> None:
    np.savez(path, x=np.zeros((3, 8, 4), dtype=np.int64))


def strings(path: Path) -> None:
    np.savez(path, x=np.full((3, 8, 4), "1.0"))


def labels_as_numbers(path: Path) -> None:
    np.savez(path, x=swap(3).numpy(), violates=np.array([0, 1, 0]))


def labels_too_few(path: Path) -> None:
    np.savez(path, x=swap(3).numpy(), violates=np.array([True, False]))


def labels_per_waypoint(path: Path) -> None:
    np.savez(path, x=swap(3).numpy(), violates=np.zeros((3, 32), dtype=bool))


def missing(path: Path) -> None:
    pass


UNREADABLE = (text, empty, folder, single_array, truncated, corrupt, flipped, encrypted, broken_header, pickled)


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (missing, "no such file"),
        *((write, "expected an .npz file with numeric arrays") for write in UNREADABLE),
        (without_x, "expected an array named x"),
        (integers, "x holds int64, expected floating-point"),
        (strings, "x holds <U3, expected floating-point"),
        (labels_as_numbers, r"violates holds int64 of shape \(3,\), expected bool"),
        (labels_too_few, r"violates holds bool of shape \(2,\), expected bool of shape \(3,\)"),
        (labels_per_waypoint, r"violates holds bool of shape \(3, 32\)"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_an_unusable_file_is_refused_in_one_line(tmp_path: Path, write: Callable[[Path], None], reason: str) -> None:
    """The line names the setting data.path, the file, and what is wrong with it."""
    path = tmp_path / "demonstrations.npz"
    write(path)
    with pytest.raises(DemonstrationError, match=reason) as refusal:
        load(path)
    assert str(refusal.value).startswith(f"data.path={path}: ")
    assert "\n" not in str(refusal.value)


def test_a_file_may_say_in_which_units_and_how_long(tmp_path: Path) -> None:
    """Numbers of any kind arrive as floats; what the file does not say is left to the task."""
    path = tmp_path / "demonstrations.npz"
    np.savez(path, x=swap(3).numpy(), scale=np.int64(4), offset=np.array([1, -0.5], np.float32), seconds=2.5)
    loaded = load(path)
    assert (loaded.scale, loaded.offset, loaded.seconds) == (4.0, [1.0, -0.5], 2.5)
    assert isinstance(loaded.scale, float)
    np.savez(path, x=swap(3).numpy(), seconds=2)
    assert load(path)[1:] == (None, None, None, 2.0)


@pytest.mark.parametrize(
    "written",
    [
        Demonstrations(swap(3)),
        Demonstrations(swap(3), torch.tensor([True, False, True]), 4.0, [1.0, -0.5], 2.5),
        Demonstrations(swap(3), scale=3.0),
        Demonstrations(swap(3), offset=[0.0, 0.0]),
    ],
)
def test_what_is_saved_is_loaded(written: Demonstrations, tmp_path: Path) -> None:
    save(tmp_path / "new.npz", written)
    loaded = load(tmp_path / "new.npz")
    assert torch.equal(loaded.x, written.x)
    labels = [None if one.violates is None else one.violates.tolist() for one in (loaded, written)]
    assert labels[0] == labels[1]
    assert loaded[2:] == written[2:]


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("scale", [1.0, 2.0], r"scale has shape \(2,\), expected \(\), finite numbers"),
        ("scale", "2", "scale has shape .*, expected"),
        ("scale", True, "scale has shape .*, expected"),
        ("scale", math.nan, "scale has shape .*, finite numbers"),
        ("scale", 0.0, "scale=0.0: expected a number above 0"),
        ("seconds", -1, "seconds=-1.0: expected a number above 0"),
        ("offset", 1.0, r"offset has shape \(\), expected \(2,\)"),
        ("offset", [1.0, 2.0, 3.0], r"offset has shape \(3,\), expected \(2,\)"),
        ("offset", [0.0, math.inf], "offset has shape .*, finite numbers"),
    ],
)
def test_numbers_of_a_file_that_cannot_be_used_are_refused(name: str, value: Any, said: str, tmp_path: Path) -> None:
    path = tmp_path / "demonstrations.npz"
    arrays: dict[str, Any] = {"x": swap(3).numpy(), name: value}
    np.savez(path, **arrays)
    with pytest.raises(DemonstrationError, match=f"^data.path={path}: {said}") as refusal:
        load(path)
    assert "\n" not in str(refusal.value)


def spoiled(value: float) -> Tensor:
    x = swap(5)
    x[2, 7, 1] = value
    x[4, 0, 0] = value
    return x


@pytest.mark.parametrize(
    ("x", "reason"),
    [
        pytest.param(torch.zeros(32, 4), r"shape \(32, 4\)", id="one trajectory alone"),
        pytest.param(torch.zeros(()), r"shape \(\)", id="a number"),
        pytest.param(torch.zeros(5, 32, 2, 2), r"shape \(5, 32, 2, 2\)", id="robots in a dimension of their own"),
        pytest.param(torch.zeros(5, 32, 0), r"shape \(5, 32, 0\)", id="no numbers"),
        pytest.param(torch.zeros(5, 2, 4), "T >= 3", id="nothing between start and goal"),
        pytest.param(torch.zeros(0, 32, 4), "empty", id="no trajectory"),
        pytest.param(spoiled(math.nan), "2 trajectories hold NaN or infinity, the first is 2", id="NaN"),
        pytest.param(spoiled(-math.inf), "2 trajectories hold NaN or infinity, the first is 2", id="infinity"),
        pytest.param(spoiled(1.001), "2 trajectories leave the workspace .*, the first is 2", id="outside"),
        pytest.param(spoiled(-1.001), "2 trajectories leave the workspace .*, the first is 2", id="outside below"),
    ],
)
def test_trajectories_that_cannot_be_used_are_refused(x: Tensor, reason: str) -> None:
    """The line names the data, counts the bad trajectories and says which is the first."""
    with pytest.raises(DemonstrationError, match=f"^these data: .*{reason}") as refusal:
        check(x, "these data")
    assert "\n" not in str(refusal.value)


def test_the_workspaces_border_belongs_to_it() -> None:
    """Coordinates of exactly -1 and 1, three robots, and the fewest waypoints are fine."""
    check(spoiled(1.0), "these data")
    check(spoiled(-1.0), "these data")
    check(torch.zeros(1, 3, 6), "these data")


@pytest.mark.parametrize("D", [2, 5])
def test_a_swap_needs_two_robots_and_two_numbers_for_each(D: int) -> None:
    with pytest.raises(DemonstrationError, match=rf"x has shape \(N, 32, {D}\), expected .* two robots or"):
        Swap(32, D)
