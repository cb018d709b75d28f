"""How good trajectories are: pure functions of x (batch, T, D), in workspace units."""

import torch
from torch import Tensor

from conflow.scene.arms import Arms
from conflow.scene.constraint import Constraint
from conflow.scene.robots import Robots


def smoothness(robots: Robots, x: Tensor) -> Tensor:
    """Mean over waypoints and bodies of the norm of the second difference of positions, (batch,).

    1 / (T - 2) sum_i |p_{i+1} - 2 p_i + p_{i-1}|, in workspace units per waypoint squared: smaller is smoother.
    """
    return _acceleration(robots, x).mean(dim=(1, 2))


def _acceleration(robots: Robots, x: Tensor) -> Tensor:
    """The norm of the second difference of each body's positions, (batch, T - 2, bodies)."""
    p = robots.points(x)
    return torch.linalg.vector_norm(p[:, 2:] - 2 * p[:, 1:-1] + p[:, :-2], dim=3)


def peak_acceleration(robots: Robots, x: Tensor) -> Tensor:
    """Another reading of smoothness: as `smoothness`, the largest over waypoints in place of the mean, (batch,)."""
    return _acceleration(robots, x).mean(dim=2).amax(dim=1)


def squared_acceleration(robots: Robots, x: Tensor) -> Tensor:
    """Another reading of smoothness: the mean over waypoints and bodies of the squared second difference, (batch,)."""
    return _acceleration(robots, x).square().mean(dim=(1, 2))


def path_length(robots: Robots, x: Tensor) -> Tensor:
    """Mean over bodies of the length of the path, sum_i |p_{i+1} - p_i| in workspace units, (batch,)."""
    return torch.linalg.vector_norm(robots.points(x).diff(dim=1), dim=3).sum(dim=1).mean(dim=1)


def hand_path_length(arms: Arms, x: Tensor) -> Tensor:
    """Mean over arms of the length of their hands' paths, in metres, (batch,)."""
    return torch.linalg.vector_norm(arms.hands(x).diff(dim=1), dim=3).sum(dim=1).mean(dim=1)


def joint_path_length(arms: Arms, x: Tensor) -> Tensor:
    """The length of the path of all joints together, sum_i |q_{i+1} - q_i| in radians, (batch,)."""
    return torch.linalg.vector_norm(arms.joints(x).diff(dim=1), dim=2).sum(dim=1)


def joint_smoothness(arms: Arms, x: Tensor) -> Tensor:
    """As `smoothness`, of all joints together: the mean of |q_{i+1} - 2 q_i + q_{i-1}| in radians, (batch,)."""
    return torch.linalg.vector_norm(arms.joints(x).diff(n=2, dim=1), dim=2).mean(dim=1)


def collision_intensity(constraint: Constraint, x: Tensor) -> Tensor:
    """The share of waypoints in violation, (batch,)."""
    return 1 - (constraint.clearance(x) >= 0).to(x.dtype).mean(dim=1)


def leaves_workspace(x: Tensor) -> Tensor:
    """Whether some number of some waypoint is outside [-1, 1], or is none, boolean (batch,).

    >>> leaves_workspace(torch.tensor([[[0.5, -1.0]], [[1.1, 0.0]], [[torch.nan, 0.0]]]))
    tensor([False,  True,  True])
    """
    return ~(x.abs().flatten(1).amax(dim=1) <= 1)


def keeps(constraint: Constraint, x: Tensor) -> Tensor:
    """Whether x keeps a constraint on the straight lines between its waypoints too, boolean (batch,)."""
    return constraint.closest(x, x.new_zeros(len(x))) >= 0


def endpoint_error(robots: Robots, x: Tensor, x_1: Tensor, waypoint: int) -> Tensor:
    """Mean over bodies of the distance between x and x_1 (batch, T, D) at a waypoint, (batch,)."""
    return torch.linalg.vector_norm((robots.points(x) - robots.points(x_1))[:, waypoint], dim=2).mean(dim=1)
