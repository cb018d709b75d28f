"""Demonstrations from files of tracks: two agents on known lines, written the ways that trackers write them."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from conflow.demonstrations import from_tracks
from conflow.errors import ConfigError
from conflow.recordings.windows import Windows, closest, read
from conflow.scene.demonstrations import load
from conflow.training import config
from conflow.training.build import build_task
from tests.papers import label

Row = tuple[int, int, float, float]
FPS, SECONDS, T = 10, 4.0, 21
SPEED, APART = 1.2, 0.5
"""Metres per second of two agents who walk towards each other on lines so many metres apart, and meet at frame 50."""


def meeting(identities: tuple[int, int] = (7, 3), last: int = 100, start: int = 0) -> list[Row]:
    """x = -+SPEED (t - 5 s), y = +-APART / 2."""
    return [
        (who, frame, sign * SPEED * (frame - 50) / FPS, sign * APART / 2)
        for who, sign in zip(identities, (1, -1), strict=True)
        for frame in range(start, last + 1)
    ]


def written(path: Path, rows: list[Row], form: str = "{} {} {:.6f} {:.6f}", head: str = "# framerate: 10\n") -> Path:
    path.write_text(head + "".join(form.format(*row) + "\n" for row in rows))
    return path


def check(found: Windows) -> None:
    """The one window: 4 s around frame 50, the agent from the left first, in closed form."""
    (x,) = found.x.double()
    t = torch.linspace(-2, 2, T).double()
    truth = torch.stack([SPEED * t, torch.full((T,), APART / 2).double(), -SPEED * t, torch.full((T,), -APART / 2)], 1)
    torch.testing.assert_close(found.scale * x, truth, rtol=0, atol=1e-5)  # six digits in the file
    assert found.scale == pytest.approx(SPEED * 2 / 0.95)
    assert found.ids.tolist() == [[7, 3]]
    assert found.frame.tolist() == [50]
    assert found.dt == pytest.approx(SECONDS / (T - 1))


FORMS: dict[str, tuple[str, str, Callable[[Row], tuple[float, ...]]]] = {
    "blanks, id first": ("{:.0f} {:.0f} {:.6f} {:.6f}", "# framerate: 10\n", lambda r: r),
    "commas with a header": ("{:.6f},{:.0f},{:.6f},{:.0f}", "x,frame,y,id\n", lambda r: (r[2], r[1], r[3], r[0])),
    "tabs, frame first": ("{:.0f}\t{:.0f}\t{:.6f}\t{:.6f}", "", lambda r: (r[1], r[0], r[2], r[3])),
    "PedPy": (
        "{:.0f}\t{:.0f}\t{:.6f}\t{:.6f}\t0",
        "# description: a test\n# framerate: 10.00 fps\n# id\tframe\tx/m\ty/m\tz/m\n",
        lambda r: r,
    ),
    "obsmat.txt": ("{:e} {:e} {:e} 0 {:e} 0 0 0", "", lambda r: (r[1], r[0], r[2], r[3])),
    "centimetres": (
        "{:.0f} {:.0f} {:.4f} {:.4f}",
        "# x/cm y/cm\n# framerate: 10\n",
        lambda r: (r[0], r[1], 100 * r[2], 100 * r[3]),
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_the_same_window_is_found_however_it_is_written(form: str, tmp_path: Path) -> None:
    row, head, arranged = FORMS[form]
    path = tmp_path / "tracks.txt"
    path.write_text(head + "".join(row.format(*arranged(one)) + "\n" for one in meeting()))
    check(read(path, 2, SECONDS, T, None if "10" in head else FPS))


def test_unsorted_rows_and_repeated_ones_change_nothing(tmp_path: Path) -> None:
    rows = meeting()
    order = np.random.default_rng(0).permutation(len(rows))
    found = read(written(tmp_path / "a.txt", [rows[i] for i in order] + rows[:30]), 2, SECONDS, T)
    check(found)
    assert "30 repeated rows" in found.summary


def test_short_gaps_are_filled_and_long_ones_split_a_track(tmp_path: Path) -> None:
    """On straight lines what is filled in is exact; within a second of the meeting nothing of it is left otherwise."""
    short = [row for row in meeting() if not 48 <= row[1] <= 51]
    found = read(written(tmp_path / "short.txt", short), 2, SECONDS, T)
    torch.testing.assert_close(found.scale * found.x[0, :, 0], SPEED * torch.linspace(-2, 2, T), rtol=0, atol=1e-5)
    long = [row for row in meeting() if not 47 <= row[1] <= 53]
    with pytest.raises(ConfigError, match="no window in 4 tracks"):
        read(written(tmp_path / "long.txt", long), 2, 6.0, T)


def test_an_agent_at_two_places_in_a_frame_counts_as_not_seen(tmp_path: Path) -> None:
    found = read(written(tmp_path / "a.txt", [*meeting(), (7, 20, 5.0, 5.0)]), 2, SECONDS, T)
    check(found)
    assert "2 rows that put an agent at two places" in found.summary


def test_who_walks_the_same_way_meets_only_where_that_is_asked_for(tmp_path: Path) -> None:
    """The second one follows half a metre beside the first."""
    rows = [(who, f, SPEED * f / FPS, who * (APART + abs(f - 50) / 1000)) for who in (0, 1) for f in range(101)]
    path = written(tmp_path / "a.txt", rows)
    with pytest.raises(ConfigError, match=r"^opposite=1: .*nobody walks in opposite directions, expected 0"):
        read(path, 2, SECONDS, T)
    (x,) = read(path, 2, SECONDS, T, opposite=False).x
    assert float((x[:, 2] - x[:, 0]).abs().max()) < 1e-6


def test_tracks_that_are_too_short_or_too_far_apart_are_said(tmp_path: Path) -> None:
    path = written(tmp_path / "a.txt", meeting())
    with pytest.raises(ConfigError, match=r"seconds=12: .* together is 10.00 s, expected less"):
        read(path, 2, 12.0, T)
    far = [(who, frame, x, 20 * y) for who, frame, x, y in meeting()]
    with pytest.raises(ConfigError, match=r"near=2: .*no 2 of 4 s come that close"):
        read(written(tmp_path / "far.txt", far), 2, SECONDS, T)


def test_a_single_agent_gives_windows_one_after_the_other(tmp_path: Path) -> None:
    found = read(written(tmp_path / "a.txt", meeting()), 1, SECONDS, T)
    assert found.x.shape == (4, T, 2), "of ten seconds two windows of four, of each of both"


def test_every_pair_has_one_window_at_its_closest_approach(tmp_path: Path) -> None:
    """Three pairs in turn, 300 frames apart: the distance at the middle of each window is the smallest, APART."""
    rows = [(10 * k + who, f + 300 * k, x, y) for k in range(3) for who, f, x, y in meeting((0, 1))]
    found = read(written(tmp_path / "a.txt", rows), 2, SECONDS, T)
    assert sorted(found.frame.tolist()) == [50, 350, 650]
    torch.testing.assert_close(found.scale * closest(found.x), torch.full((3,), APART), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "holds no rows"),
        ("# framerate: 10\n1 2 x 4\n", "line 2 is '1 2 x 4', expected numbers"),
        ("# framerate: 10\n1 2 3\n", "the first row has 3 columns"),
        ("# framerate: 10\n1 2.5 3 4\n", "line 2 has 2.5 for id or frame, expected a whole number"),
        ("id,x,y\n1,2,3\n", "names 0 columns for frame"),
        ("1 2 3 4\n", "fps: .* has no comment such as '# framerate: 25'"),
    ],
)
def test_what_is_no_file_of_tracks_is_refused_in_one_line(content: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    path.write_text(content)
    with pytest.raises(ConfigError, match=said) as refused:
        read(path, 2, SECONDS, T)
    assert "\n" not in str(refused.value)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_command_writes_a_file_that_brings_plans_back_into_metres(place: Path) -> None:
    """The radius that the summary names for half of the windows labels so many."""
    rows = [(10 * k + who, f + 300 * k, x, y * (1 + k / 10)) for k in range(20) for who, f, x, y in meeting((0, 1))]
    written(place / "tracks.txt", rows)
    options = {
        "from": "tracks.txt",
        "out": "NAME.npz",
        "agents": "2",
        "seconds": "4",
        "T": str(T),
        "fps": "",
        "opposite": "1",
        "near": "2",
    }
    said = from_tracks(options)
    loaded = load("tracks.npz")
    assert "Written: tracks.npz" in said
    assert loaded.x.shape == (20, T, 4)
    assert loaded.scale == pytest.approx(SPEED * 2 / 0.95)
    assert loaded.seconds == 4
    radius, share = re.findall(r"([\d.]+) \([\d.]+ m\) makes (\d+) %", said)[-1]
    settings = config.load([f"constraint.radius={radius}"])
    assert build_task(settings, T).robots.count == 2
    assert float(label(settings).violation(loaded.x).double().mean()) == pytest.approx(int(share) / 100, abs=0.005)
