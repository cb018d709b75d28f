"""Maps that others publish results on, with robots that start and end anywhere in them."""

from collections.abc import Sequence

from conflow.scene.settings import Box
from conflow.scene.tasks.random import Random

CORNERS = 0.15
"""Radius of a box's corners, as a share of its shorter side."""
DISC = 0.1768
"""Radius of the discs that shelves and rooms are made of, and where along a wall of six their centres are."""
ALONG_A_WALL = (-0.625, -0.375, -0.125, 0.125, 0.375, 0.625)


class Highways(Random):
    """MMD's map of roads around a block in the middle, between others along the border."""

    numbers = (10, 20)

    def boxes(self) -> Sequence[Box]:
        sides = [(0.0, 0.875, 0.5, 0.25), (0.0, -0.875, 0.5, 0.25), (0.875, 0.0, 0.25, 0.5), (-0.875, 0.0, 0.25, 0.5)]
        corners = [(x, y, 0.25, 0.25) for x in (-0.875, 0.875) for y in (-0.875, 0.875)]
        return [rounded(*box) for box in ((0.0, 0.0, 0.5, 0.5), *sides, *corners)]


class Conveyor(Random):
    """MMD's map of three belts, one above the other."""

    numbers = (10, 20)

    def boxes(self) -> Sequence[Box]:
        return [rounded(*box) for box in ((0.0, 0.0, 0.8, 0.1), (0.0, 0.35, 1.0, 0.1), (0.0, -0.35, 1.0, 0.1))]


class Shelf(Random):
    """SMD's map of two walls of discs, open at both ends alone, where one robot passes at a time."""

    numbers, apart, clear = (6, 9, 12, 18), 0.17, 0.11

    def boxes(self) -> Sequence[Box]:
        return [disc(x, y) for x in (-0.3, 0.4) for y in ALONG_A_WALL]


class Room(Random):
    """SMD's map of two walls of discs that cross, open at the border alone, where one robot passes at a time."""

    numbers, apart, clear = (6, 9, 12, 18), 0.17, 0.11

    def boxes(self) -> Sequence[Box]:
        return [disc(a, 0.0) for a in ALONG_A_WALL] + [disc(0.0, a) for a in ALONG_A_WALL]


def rounded(x: float, y: float, width: float, height: float) -> Box:
    """A box with MMD's corners."""
    return Box(x, y, width, height, CORNERS * min(width, height))


def disc(x: float, y: float) -> Box:
    """A disc of a wall: a box that is all corners."""
    return Box(x, y, 2 * DISC, 2 * DISC, DISC)
