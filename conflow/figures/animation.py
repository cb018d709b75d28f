"""Robots that move, as one HTML file that needs nothing else."""

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from conflow.figures.workspace import COLLISION, OBSTACLE, ROBOTS, TITLES
from conflow.training.build import judged_radius
from conflow.training.evaluation import Evaluation
from conflow.training.module import SETTINGS, ConFlow

TEMPLATE = Path(__file__).with_name("animation.html")
FRAMES = 200
EACH = 2


def animation(model: ConFlow, evaluation: Evaluation, name: str) -> str:
    """The robots of a few trajectories under the three settings, side by side.

    Up to two trajectories that collide without guidance and two that do not; all settings start from the same x_0.
    """
    obstacle = model.config.sample.obstacle
    violates = model.robots.violation(evaluation.samples["none"])
    chosen = [*violates.nonzero().flatten()[:EACH].tolist(), *(~violates).nonzero().flatten()[:EACH].tolist()]
    content = {
        "name": name,
        "obstacle": [obstacle.x, obstacle.y, obstacle.radius],
        "colours": {"robots": ROBOTS, "collision": COLLISION, "obstacle": OBSTACLE},
        "scenes": [
            {
                "label": f"{i}: {'collides' if violates[i] else 'no collision'} without guidance",
                "panels": [
                    _panel(model, evaluation.samples[setting][i : i + 1], TITLES[setting], setting == "obstacle")
                    for setting in SETTINGS
                ],
            }
            for i in chosen
        ],
    }
    # A name must not end the script element that holds it.
    data = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    return TEMPLATE.read_text(encoding="utf-8").replace("/*CONTENT*/", data)


def frames(x: Tensor) -> Tensor:
    """Trajectories (batch, T, D) with the straight lines between waypoints filled in, some FRAMES of them in all."""
    fill = max(1, round(FRAMES / (x.shape[1] - 1)))
    tau = torch.arange(fill)[:, None] / fill
    between = torch.lerp(x[:, :-1, None], x[:, 1:, None], tau).flatten(1, 2)
    return torch.cat([between, x[:, -1:]], dim=1)


def _panel(model: ConFlow, x: Tensor, title: str, around_obstacle: bool) -> dict[str, Any]:
    """One trajectory (1, T, D): each frame's positions, the discs' radius, and the gaps to what touches at 0."""
    x = frames(x)
    return {
        "title": title,
        "aroundObstacle": around_obstacle,
        "radius": (model.config.constraint.radius if around_obstacle else judged_radius(model.config)) / 2,
        "positions": _rounded(x[0].unflatten(1, (-1, 2))),
        "robotGap": _rounded(model.robots.clearance(x)[0]),
        "obstacleGap": _rounded(model.obstacle.clearance(x)[0]),
    }


def _rounded(x: Tensor) -> Any:
    """Nested lists with four digits: a fiftieth of a pixel."""
    return [_rounded(row) for row in x] if x.ndim > 1 else [round(value, 4) for value in x.tolist()]
