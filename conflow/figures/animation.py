"""Robots that move, as one HTML file that needs nothing else."""

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from conflow.figures.workspace import COLLISION, OBSTACLE, ROBOTS, seen_from_above, standing, titled
from conflow.scene.constraint import Avoidance, Constraint, Sum, Workspace
from conflow.training.build import NONE, joined
from conflow.training.evaluation import Evaluation
from conflow.training.model import ConFlow

TEMPLATE = Path(__file__).with_name("animation.html")
FRAMES = 200
EACH = 2


def animation(model: ConFlow, evaluation: Evaluation, name: str) -> str:
    """The robots of a few trajectories under every setting, side by side.

    Up to two trajectories in violation without guidance and two that are not; all settings start from the same x_0.
    """
    violates = model.trained.violation(evaluation.samples[NONE])
    chosen = [*violates.nonzero().flatten()[:EACH].tolist(), *(~violates).nonzero().flatten()[:EACH].tolist()]
    content = {
        "name": name,
        "obstacles": model.task.obstacles(),
        "owner": model.task.robots.owner.tolist(),
        "traced": [*model.task.robots.traced],
        "colours": {"robots": ROBOTS, "collision": COLLISION, "obstacle": OBSTACLE},
        "scenes": [
            {
                "label": f"{i}: {'in violation' if violates[i] else 'feasible'} without guidance",
                "panels": [
                    _panel(model, evaluation.samples[setting][i : i + 1], setting) for setting in model.settings
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


def gaps(constraint: Constraint, x: Tensor) -> Tensor:
    """The clearance of trajectories (batch, T, D) at each of their frames, (batch, frames).

    That of a constraint on motion, as on speed, goes straight between those at waypoints: it would take frames for
    waypoints, and their distance for a step.
    """
    terms = constraint.terms if isinstance(constraint, Sum) else [constraint]
    found = [
        term.clearance(frames(x)) if _of_positions(term) else frames(term.clearance(x)[..., None])[..., 0]
        for term in terms
    ]
    return torch.stack(found).amin(dim=0)


def _of_positions(constraint: Constraint) -> bool:
    """Whether a constraint is one on where bodies are; others say themselves what holds between waypoints."""
    subdivides = type(constraint).swept_clearance is Constraint.swept_clearance
    return subdivides or isinstance(constraint, Avoidance | Workspace)


def _panel(model: ConFlow, x: Tensor, setting: str) -> dict[str, Any]:
    """One trajectory (1, T, D): each frame's positions, the bodies' radii, and the gaps to what is met at 0.

    Obstacles are there in all panels, or, where they appear at inference, in those that guide around them.
    """
    appearing = [model.judged[name] for name in model.u_c_at_inference]
    around = any(name in model.u_c_at_inference for name in model.guided_around(setting))
    robots = model.task.robots if around else model.trained.robots
    return {
        "title": titled(setting),
        "obstaclesThere": around or bool(standing(model.task)),
        "radii": [round(radius, 4) for radius in robots.radii.tolist()],
        "positions": _rounded(seen_from_above(robots, frames(x))[0]),
        "keptGap": _rounded(gaps(model.trained, x)[0]),
        "obstacleGap": _rounded(gaps(joined(appearing), x)[0]) if around else None,
    }


def _rounded(x: Tensor) -> Any:
    """Nested lists with four digits: a fiftieth of a pixel."""
    return [_rounded(row) for row in x] if x.ndim > 1 else [round(value, 4) for value in x.tolist()]
