"""Robots that avoid each other reciprocally, for comparison: what is simulated, and that it ends."""

import itertools
import time

import numpy as np
import pytest
import torch

from conflow.orca import ARRIVED, SPEED, STEP, Crossing, Simulator, outline
from conflow.scene.crowd import MapAvoidance
from conflow.scene.robots import Crowd
from conflow.scene.settings import Box

BOX = Box(0.0, -0.2, 0.5, 0.3, 0.1)  # up to y = -0.05, where robots that evade each other pass
START = np.array([[-0.8, 0.05], [0.8, 0.1]])
GOAL = np.array([[0.8, 0.05], [-0.8, 0.1]])


def test_the_polygon_of_a_rounded_box_goes_round_it_and_hardly_farther() -> None:
    corners = torch.tensor(outline(BOX))
    edges = corners.roll(-1, dims=0) - corners
    turns = edges[:, 0] * edges.roll(-1, dims=0)[:, 1] - edges[:, 1] * edges.roll(-1, dims=0)[:, 0]
    assert (turns > 0).all()  # convex, counterclockwise
    along = torch.linspace(0, 1, 21)[:, None, None]
    around = (corners + along * edges).flatten(0, 1)
    away = MapAvoidance(Crowd(1, 1e-9), [BOX]).clearance(around[:, None])
    assert away.min() > -1e-6
    # A corner of the polygon is farther out than its arc by a share 1 / cos(pi / 16) - 1 = 0.0196 of the rounding.
    assert away.max() < 0.02 * BOX.rounding


def test_robots_arrive_and_keep_their_distance_from_each_other_and_from_the_map() -> None:
    pytest.importorskip("pyrvo")
    path = Simulator()(Crossing(START, GOAL, 0.05, [BOX], 10.0, (0,)), seconds=60)
    assert path is not None
    assert np.linalg.norm(path[-1] - GOAL, axis=1).max() <= ARRIVED
    assert np.linalg.norm(path[:, 0] - path[:, 1], axis=1).min() >= 0.1
    assert np.linalg.norm(np.diff(path, axis=0), axis=2).max() <= SPEED * STEP + 1e-6
    x = torch.from_numpy(path).flatten(1).float()[None]
    assert MapAvoidance(Crowd(2, 0.05), [BOX]).clearance(x).min() >= -1e-4


def test_who_needs_longer_is_given_up() -> None:
    """The way is 1.6 long and the top speed 0.6, so 2.5 seconds are too few."""
    pytest.importorskip("pyrvo")
    assert Simulator()(Crossing(START, GOAL, 0.05, [], 2.5, (0,)), seconds=60) is None


def test_one_that_never_ends_is_ended_and_the_next_one_runs() -> None:
    pytest.importorskip("pyrvo")
    simulate, began = Simulator(), time.monotonic()
    endless = itertools.repeat(BOX)  # obstacles that are never all there
    assert simulate(Crossing(START, GOAL, 0.05, endless, 10.0, (0,)), seconds=0.5) is None  # type: ignore[arg-type]
    assert time.monotonic() - began < 60  # to start a process again takes some seconds on a busy machine
    assert simulate(Crossing(START, GOAL, 0.05, [], 10.0, (0,)), seconds=60) is not None


def test_a_time_that_is_over_just_as_the_answer_comes_leaves_no_lock_behind() -> None:
    pytest.importorskip("pyrvo")
    simulate, crossing = Simulator(), Crossing(START, GOAL, 0.05, [BOX], 10.0, (0,))
    began = time.monotonic()
    assert simulate(crossing, seconds=60) is not None
    takes = time.monotonic() - began
    for share in (0.6, 0.8, 0.9, 1.0, 1.1, 1.3):
        simulate(crossing, share * takes)
    assert simulate(crossing, seconds=60) is not None


def test_a_process_that_dies_has_not_solved_its_scene() -> None:
    pytest.importorskip("pyrvo")
    simulate = Simulator()
    assert simulate(Crossing(START, GOAL, 0.05, None, 10.0, (0,)), seconds=60) is None  # type: ignore[arg-type]
    assert simulate(Crossing(START, GOAL, 0.05, [], 10.0, (0,)), seconds=60) is not None
