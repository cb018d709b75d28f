"""Meetings: when which tracks come close to each other."""

import heapq
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from conflow.recordings.table import BoolArray, FloatArray, IntArray
from conflow.recordings.tracks import Tracks

CHUNK = 50_000
"""Rows in which neighbours are looked for at once: so many that numpy is fast, yet memory bounded."""


class Meetings(NamedTuple):
    """Sets of tracks, members (sets, agents), and the frame in which each set meets, (sets,)."""

    members: IntArray
    frame: FloatArray

    def select(self, which: BoolArray) -> "Meetings":
        return Meetings(self.members[which], self.frame[which])


def cut(tracks: Tracks, width: float) -> Meetings:
    """Windows of single tracks, `width` frames long, one after the other."""
    count = np.floor((tracks.last - tracks.first) / width + 1e-9).astype(np.int64)
    track, number = _each(count)
    return Meetings(track[:, None], tracks.first[track] + (number + 0.5) * width)


def closest_approaches(tracks: Tracks, agents: int, near: float) -> Meetings:
    """The closest approach of every set of tracks that comes within `near`."""
    track, frame = _grid(tracks)
    x = tracks.at(track, frame.astype(np.float64))
    # Chunks of whole frames: a set is complete within one frame.
    begin = np.flatnonzero(np.diff(frame, prepend=frame[:1] - 1))
    begin = begin[np.diff(begin // CHUNK, prepend=-1) > 0]
    best = [(np.empty((0, agents), np.int64), np.empty(0), np.empty(0, np.int64))]
    for low, high in pairwise([*begin, len(frame)]):
        rows, distance = _together(x[low:high], frame[low:high], agents, near)
        best.append(_nearest(track[low:high][rows], distance, frame[low:high][rows[:, 0]]))
    members, _, when = _nearest(*(np.concatenate(parts) for parts in zip(*best, strict=True)))
    return Meetings(members, when.astype(np.float64))


def _each(count: IntArray) -> tuple[IntArray, IntArray]:
    """Of `count` things each: whose they are, and their numbers among their own, as 0, 0, 1 and 0, 1, 0 of 2 and 1."""
    owner = np.repeat(np.arange(len(count)), count)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)


def _grid(tracks: Tracks) -> tuple[IntArray, IntArray]:
    """Every track at every frame of a grid with the file's usual step: (track, frame), in order of frame and track."""
    if not len(tracks.ids):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    phases, counts = np.unique(tracks.frame % tracks.step, return_counts=True)
    phase = phases[counts.argmax()]  # that of most rows, where nothing is interpolated
    low, high = -((phase - tracks.first) // tracks.step), (tracks.last - phase) // tracks.step
    count = np.maximum(high - low + 1, 0)
    track, number = _each(count)
    frame = (low[track] + number) * tracks.step + phase
    order = np.argsort(frame, kind="stable")
    return track[order], frame[order]


def _together(x: FloatArray, frame: IntArray, agents: int, near: float) -> tuple[IntArray, FloatArray]:
    """Sets of rows of one frame of which each is within `near` of each, with their largest distance.

    Sets grow by one row after the other, from pairs of neighbours.
    """
    # A third coordinate sets frames apart, so that one tree serves all of them.
    height = np.searchsorted(np.unique(frame), frame) * (2 * near)
    pairs = cKDTree(np.column_stack([x, height])).query_pairs(near, output_type="ndarray").astype(np.int64)
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    partners = np.bincount(pairs[:, 0], minlength=len(x))
    begin = np.cumsum(partners) - partners
    sets, distance = pairs, np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    for _ in range(agents - 2):
        old, number = _each(partners[sets[:, -1]])
        new = pairs[begin[sets[old, -1]] + number, 1]
        apart = np.linalg.norm(x[sets[old]] - x[new][:, None], axis=2).max(axis=1)
        keep = apart <= near
        sets = np.column_stack([sets[old], new])[keep]
        distance = np.maximum(distance[old], apart)[keep]
    return sets, distance


def _nearest(members: IntArray, distance: FloatArray, frame: IntArray) -> tuple[IntArray, FloatArray, IntArray]:
    """Of each set the smallest distance and its frame, the first of several."""
    order = np.lexsort((frame, distance, *members.T[::-1]))
    members, distance, frame = members[order], distance[order], frame[order]
    new = np.concatenate([[True], np.any(members[1:] != members[:-1], axis=1)])[: len(members)]
    return members[new], distance[new], frame[new]


def lies_inside(tracks: Tracks, meetings: Meetings, width: float) -> BoolArray:
    """Whether the window of `width` frames lies inside all of a set's tracks, (sets,)."""
    first, last = tracks.first[meetings.members].max(axis=1), tracks.last[meetings.members].min(axis=1)
    return (meetings.frame - width / 2 >= first - 1e-6) & (meetings.frame + width / 2 <= last + 1e-6)


def longest_together(tracks: Tracks, agents: int) -> float:
    """For how many frames at most the same `agents` tracks are present together."""
    best = 0
    ends: list[int] = []
    for first, last in sorted(zip(tracks.first.tolist(), tracks.last.tolist(), strict=True)):
        heapq.heappush(ends, last)
        if len(ends) > agents:
            heapq.heappop(ends)
        if len(ends) == agents:  # of all that began, those that stay longest
            best = max(best, ends[0] - first)
    return best
