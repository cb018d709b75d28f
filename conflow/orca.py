"""Reciprocal collision avoidance (ORCA) by `pyrvo`, in a process of its own: in some maps a step of it never ends."""

import signal
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np

from conflow.scene.settings import Box

STEP, SPEED, JITTER = 0.05, 0.6, 1e-3
"""Seconds of a simulated step; the top speed, that of demonstrations; and how much of it is chance."""
SEES, AHEAD = 1.0, 2.0
"""How far robots see each other, and for how many seconds ahead they avoid each other and what is in the way."""
ARRIVED = 0.05
"""Within this of their goals robots have arrived (as published)."""
CORNER = 4
"""Corners of the polygon that a rounded corner becomes."""


class Crossing(NamedTuple):
    """What is simulated.

    Attributes:
        start, goal: of robots, (count, 2).
        radius: of all robots.
        boxes: what is in the way.
        seconds: after which robots are given up.
        seed: of the jitter.
    """

    start: np.ndarray
    goal: np.ndarray
    radius: float
    boxes: Sequence[Box]
    seconds: float
    seed: Sequence[int]


def walk(crossing: Crossing) -> np.ndarray | None:
    """The positions of all robots after every step until they have arrived, (steps, count, 2); None if they do not.

    In exactly symmetric scenes it deadlocks, so preferred velocities are jittered. They go straight for the goal, and
    around what is in the way no farther than they see.
    """
    import pyrvo

    start, goal, radius, boxes, seconds, seed = crossing
    draw, count = np.random.default_rng(seed), len(start)
    # Half a percent more than the radius, since it lets discs touch.
    simulator = pyrvo.RVOSimulator(STEP, SEES, count, AHEAD, AHEAD, 1.005 * radius, SPEED)
    for place in start.tolist():
        simulator.add_agent(place)
    for box in boxes:
        simulator.add_obstacle(outline(box))
    simulator.process_obstacles()
    at, path = start, [start]
    for _ in range(round(seconds / STEP)):
        wanted = (goal - at) / STEP
        speed = np.linalg.norm(wanted, axis=1, keepdims=True)
        wanted *= np.minimum(1, SPEED / np.maximum(speed, 1e-9))
        wanted += JITTER * draw.standard_normal(wanted.shape)
        for k, velocity in enumerate(wanted.tolist()):
            simulator.set_agent_pref_velocity(k, velocity)
        simulator.do_step()
        at = np.array([simulator.get_agent_position(k).to_tuple() for k in range(count)])
        path.append(at)
        if np.linalg.norm(goal - at, axis=1).max() <= ARRIVED:
            return np.stack(path)
    return None


def outline(box: Box) -> list[list[float]]:
    """A rounded box as a polygon around it, counterclockwise."""
    angles = np.pi / 2 * (np.arange(CORNER) + 0.5) / CORNER
    # As far out as keeps the edges between two corners of an arc outside it.
    reach = box.rounding / np.cos(np.pi / 4 / CORNER)
    points = []
    for quarter, (sign_x, sign_y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        middle = [box.x + sign_x * (box.width / 2 - box.rounding), box.y + sign_y * (box.height / 2 - box.rounding)]
        turned = angles + quarter * np.pi / 2
        points += (np.array(middle) + reach * np.stack([np.cos(turned), np.sin(turned)], axis=1)).tolist()
    return points


def serve(crossings: Connection) -> None:
    """Answers every crossing with its `walk`; begins with None, to say that it is there."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: whoever asks is told too, and ends this
    crossings.send(None)
    with suppress(EOFError):  # nobody asks any more
        while True:
            crossings.send(walk(crossings.recv()))


class Simulator:
    """`walk` within a time: who does not come back is ended.

    Raises:
        ModuleNotFoundError: `pyrvo` is not installed.
    """

    def __init__(self) -> None:
        import_module("pyrvo")  # to say at once that it is missing
        self._start()

    def __call__(self, crossing: Crossing, seconds: float) -> np.ndarray | None:
        """As `walk`; None too if that takes longer than `seconds`, or fails."""
        self._walks.send(crossing)
        if self._walks.poll(seconds):
            with suppress(EOFError):
                return self._walks.recv()
        self._process.kill()
        self._process.join()
        self._start()
        return None

    def _start(self) -> None:
        self._walks, theirs = Pipe()
        self._process = get_context("spawn").Process(target=serve, args=[theirs], daemon=True)
        self._process.start()
        theirs.close()  # so that the end of the process is the end of the pipe
        self._walks.recv()  # so that no scene waits for its beginning
