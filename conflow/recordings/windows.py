"""Demonstrations from tracks of people or robots: windows in which some of them meet, in one common scale."""

import math
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from conflow.errors import ConfigError
from conflow.recordings.meetings import Meetings, closest_approaches, cut, lies_inside, longest_together
from conflow.recordings.table import BoolArray, FloatArray, IntArray, frame_rate, read_table
from conflow.recordings.tracks import Tracks, tracks_of

OPPOSITE = math.radians(135)
"""Two agents whose walking directions differ by more walk in opposite directions."""

STANDING = 0.05
"""Metres per second: who moves on average slower through a window stands, and has no walking direction."""

EXTENT = 0.95
"""The largest coordinate of all windows, in workspace units."""

QUANTILES = (0.1, 0.25, 0.5)
"""Shares of infeasible windows for which the summary names a radius."""


class Windows(NamedTuple):
    """Windows of `seconds` in which `agents` agents meet, as demonstrations in workspace units.

    x[n, t] = (position(t) - centre[n]) / scale for every agent, in the order of ids[n]. Plans for them come back in
    metres relative to an encounter's centre: scale * x + offset.
    """

    x: Tensor
    """(N, T, 2 agents), float32, as (x1, y1, x2, y2, ...): evenly spaced in time, within [-0.95, 0.95]."""

    scale: float
    """Metres per workspace unit."""

    offset: FloatArray
    """(2,), zeros: every window has a centre of its own, a file has none."""

    seconds: float
    """How long a window is."""

    centre: FloatArray
    """(N, 2), metres: the midpoint of the bounding box of all the window's positions."""

    ids: IntArray
    """(N, agents): whom the file calls so."""

    frame: FloatArray
    """(N,): the frame in the middle of the window: of the closest approach, or for a single agent any."""

    summary: str
    """What was read, left out and found, and what share of the windows which `constraint.radius` makes infeasible."""

    @property
    def dt(self) -> float:
        """Seconds between two waypoints, seconds / (T - 1)."""
        return self.seconds / (self.x.shape[1] - 1)


def read(
    path: str | Path,
    agents: int = 2,
    seconds: float = 6.0,
    T: int = 32,
    fps: float | None = None,
    opposite: bool = True,
    near: float = 2.0,
) -> Windows:
    """Windows in which agents meet, from a file of tracked positions.

    The file has a row for every agent and frame, separated by commas, semicolons, tabs or blanks. A header, or a
    comment such as `# id frame x/m y/m z/m`, names the columns id, frame, x and y, others are ignored. Without a
    header these four come first, in this order or as `frame id x y`: that one is taken in which neighbours along a
    track lie nearer to each other on average. Eight columns of which the fourth never changes are those of ETH's
    obsmat.txt, frame id x z y and velocities. Positions are in metres, or in cm or mm where a comment or the header
    says so. Comments such as `# framerate: 25.00` give the frames per second.

    Of repeated rows one counts. Rows that place an agent at two places in one frame count as not seen. A track is
    filled linearly where for at most `tracks.GAP` seconds, beyond the usual step between frames, it was not seen, and
    else split.

    Of every set of `agents` tracks the closest approach is the frame at which the largest distance between two of
    them is smallest. There the set must be within `near`, and a window of `seconds` with this frame in the middle must
    lie inside all of its tracks. Frames are looked at in the file's usual step. A single agent meets nobody: its
    track is cut into windows one after the other.

    The agents of a window are sorted by where they start along the main direction of travel in the file, taken as an
    undirected axis that points to the right, or up where it is steeper.

    Args:
        path: the file.
        agents: how many meet.
        seconds: length of a window.
        T: waypoints, the first and the last at the window's ends.
        fps: frame numbers per second, where the file does not say it. ETH's obsmat.txt has every sixth frame of 15 per
            second: 15. Its hotel, UCY and the files that Social-GAN distributes have every tenth of 25: 25.
        opposite: only sets of which two walk in opposite directions, by their displacements over the window.
        near: metres. Who never comes that close does not meet.

    Raises:
        ConfigError: a setting is out of range, the file cannot be read, or it has no such window.
    """
    _check(agents, seconds, T, fps, near)
    table = read_table(Path(path))
    rate = frame_rate(path, table.fps, fps)
    tracks, read_in = tracks_of(path, table, rate)
    long = tracks.select(tracks.last - tracks.first >= seconds * rate - 1e-9)
    meetings = cut(long, seconds * rate) if agents == 1 else closest_approaches(long, agents, near)
    found = _Found(len(tracks.ids), len(long.ids), len(meetings.frame))

    inside = lies_inside(long, meetings, seconds * rate)
    meetings = meetings.select(inside)
    positions = _positions(long, meetings, seconds * rate, T)
    walks = _opposite(positions, seconds) if opposite and agents > 1 else np.full(len(positions), True)
    meetings, positions = meetings.select(walks), positions[walks]
    found = found._replace(inside=int(inside.sum()), windows=len(positions))
    if not len(positions):
        longest = longest_together(tracks, agents) / rate
        raise ConfigError(_nothing(found, agents, seconds, near, longest))

    order = _order(positions)
    positions = np.take_along_axis(positions, order[:, None, :, None], axis=2)
    ids = np.take_along_axis(long.ids[meetings.members], order, axis=1)
    centre = (positions.min(axis=(1, 2)) + positions.max(axis=(1, 2))) / 2
    centred = positions - centre[:, None, None]
    scale = float(np.abs(centred).max()) / EXTENT
    if scale == 0:
        raise ConfigError(
            f"from={path}: nobody moves in any of {len(positions)} windows, expected positions that change"
        )
    x = torch.from_numpy((centred / scale).astype(np.float32)).flatten(2)
    summary = f"{path}: {read_in} {_windows_found(found, agents, seconds, near, opposite)} {_sizes(x, scale)}"
    return Windows(x, scale, np.zeros(2), float(seconds), centre, ids, meetings.frame, summary)


def closest(x: Tensor) -> Tensor:
    """The smallest distance at waypoints between two of the agents of x (N, T, 2 agents), (N,); two agents or more.

    A window violates `constraint.radius` where this is smaller.
    """
    p = x.unflatten(2, (-1, 2))
    distances = [
        torch.linalg.vector_norm(p[:, :, a] - p[:, :, b], dim=2) for a, b in combinations(range(p.shape[2]), 2)
    ]
    return torch.stack(distances).amin(dim=(0, 2))


def _check(agents: int, seconds: float, T: int, fps: float | None, near: float) -> None:
    if agents < 1:
        raise ConfigError(f"agents={agents}: expected 1 or more")
    if T < 3:
        raise ConfigError(f"T={T}: expected 3 waypoints or more")
    for name, value in (("seconds", seconds), ("fps", 1.0 if fps is None else fps), ("near", near)):
        if not (0 < value < math.inf):
            raise ConfigError(f"{name}={value}: expected a positive number")


def _positions(tracks: Tracks, meetings: Meetings, width: float, T: int) -> FloatArray:
    """The windows' positions in metres, (sets, T, agents, 2)."""
    if not len(meetings.frame):
        return np.empty((0, T, meetings.members.shape[1], 2))
    times = meetings.frame[:, None] + width * np.linspace(-0.5, 0.5, T)
    return tracks.at(meetings.members[:, None, :], times[:, :, None])


def _opposite(positions: FloatArray, seconds: float) -> BoolArray:
    """Whether two agents walk in opposite directions, (sets,)."""
    travel = positions[:, -1] - positions[:, 0]
    length = np.linalg.norm(travel, axis=2)
    direction = travel / np.maximum(length, STANDING * seconds)[..., None]  # who stands has no unit vector
    cosine = np.einsum("sad,sbd->sab", direction, direction)
    walks = length >= STANDING * seconds
    return ((cosine < math.cos(OPPOSITE)) & walks[:, :, None] & walks[:, None, :]).any(axis=(1, 2))


def _order(positions: FloatArray) -> IntArray:
    """The agents of each window by where they start along the main axis of travel, (sets, agents)."""
    travel = (positions[:, -1] - positions[:, 0]).reshape(-1, 2)
    axis = np.linalg.eigh(travel.T @ travel)[1][:, 1]
    axis *= np.sign(axis[np.abs(axis).argmax()])
    return np.argsort(positions[:, 0] @ axis, axis=1, kind="stable")


class _Found(NamedTuple):
    """How many were left at each step."""

    tracks: int
    long: int
    sets: int
    inside: int = 0
    windows: int = 0


def _nothing(found: _Found, agents: int, seconds: float, near: float, longest: float) -> str:
    """Why there is no window, and what to change."""
    together = (
        f"the longest that {agents} are present together is {longest:.2f} s"
        if agents > 1
        else (f"the longest is {longest:.2f} s")
    )
    there = f"no window in {found.tracks} tracks, {together}"
    if longest <= 0:
        return f"agents={agents}: {there}, expected fewer agents"
    if longest < seconds:
        return f"seconds={seconds:g}: {there}, expected less than that"
    if not found.sets:
        return f"near={near:g}: {there}, but no {agents} of {seconds:g} s come that close in m, expected more"
    if not found.inside:
        return f"seconds={seconds:g}: {there}, all {found.sets} meetings are too near to a track's end, expected less"
    return f"opposite=1: {there}, in {found.inside} meetings nobody walks in opposite directions, expected 0"


def _windows_found(found: _Found, agents: int, seconds: float, near: float, opposite: bool) -> str:
    short = f"{found.tracks - found.long} tracks are shorter than {seconds:g} s."
    if agents == 1:
        return f"{short} The others give {found.windows} windows."
    aligned = f", in {found.inside - found.windows} no two walk in opposite directions" if opposite else ""
    return (
        f"{short} Of the others {found.sets} sets of {agents} come within {near:g} m of each other: "
        f"{found.sets - found.inside} meet too near to a track's end{aligned}, {found.windows} are windows."
    )


def _sizes(x: Tensor, scale: float) -> str:
    """The scale, and radii with the share of windows that each makes infeasible."""
    middle = float(x.abs().flatten(1).amax(dim=1).median())
    text = f"A workspace unit is {scale:.3g} m; half of the windows reach no further than {middle:.2f}."
    if x.shape[2] < 4:
        return text
    distance = closest(x).double().sort().values
    radii: dict[float, str] = {}  # few windows may have the same for several shares
    for share in QUANTILES:
        reached = float(distance[math.ceil(share * len(distance)) - 1])
        radius = (math.floor(1000 * reached) + 1) / 1000  # as it is printed, and above
        infeasible = float((distance < radius).double().mean())
        radii[radius] = f"{radius:.3f} ({radius * scale:.2f} m) makes {100 * infeasible:.0f} %"
    return f"{text} As constraint.radius, {', '.join(radii.values())} of them infeasible."
