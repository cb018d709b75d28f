"""From settings to the objects of `flow/` and `scene/`: the one place where a name becomes a class."""

import hashlib
from dataclasses import replace

import torch
from torch import Tensor

from conflow import errors
from conflow.flow import source
from conflow.flow.correction import Correction, covariant, gaussian_filter, repair
from conflow.flow.network import ResMLP, SpectralMLP
from conflow.flow.source import Source
from conflow.scene.constraint import Barrier, Constraint, ObstacleAvoidance, RobotAvoidance, Sum, Workspace
from conflow.scene.robots import PointRobots
from conflow.training import config
from conflow.training.config import Config


def build_source(settings: config.Source, T: int) -> Source:
    """The source p_0 on T waypoints."""
    if settings.kind == "gaussian":
        return source.gaussian(T, settings.modes)
    process = source.cgp if settings.kind == "cgp" else source.gp
    return process(T, settings.length_scale, settings.sigma_f, settings.epsilon, settings.modes)


def fitted(settings: Config, demonstrations: Tensor) -> Config:
    """The settings with the kernel most likely for demonstrations (N, T, D), where `source.fit` asks for it.

    Raises:
        ConfigError: there is none.
    """
    if not settings.source.fit:
        return settings
    index = build_source(settings.source, demonstrations.shape[1]).index.tolist()
    try:
        length_scale, sigma_f = source.fit_rbf(demonstrations, index, settings.source.epsilon)
    except ValueError as error:
        raise errors.ConfigError(f"source.fit=True: {error}") from None
    return replace(settings, source=replace(settings.source, length_scale=length_scale, sigma_f=sigma_f))


def judged_radius(settings: Config) -> float:
    """The distance of two robots' centres below which samples count as robot collisions."""
    return settings.sample.radius or settings.constraint.radius


def judge(settings: Config, D: int) -> Constraint:
    """The constraint that samples are judged by."""
    return RobotAvoidance(PointRobots(D // 2), judged_radius(settings), _barrier(settings.constraint))


def robot_avoidance(settings: Config, D: int, margin: float = 0.0) -> Constraint:
    """The constraint that labels, corrects and guides: robots keep their distance, and a margin."""
    return RobotAvoidance(PointRobots(D // 2), settings.constraint.radius + margin, _barrier(settings.constraint))


def kept(settings: Config, D: int) -> Constraint:
    """What training corrects for and guidance keeps: the robots' distance and, where asked for, the walls."""
    margin, robots = settings.correction.margin, robot_avoidance(settings, D, settings.correction.margin)
    if not settings.correction.walls:
        return robots
    return Sum([robots, Workspace(PointRobots(D // 2), margin, _barrier(settings.constraint))])


def obstacle_avoidance(settings: Config, D: int, margin: float = 0.0) -> Constraint:
    """The constraint that appears at inference alone: robots, discs of half the touching distance, miss a disc."""
    reach = settings.constraint.radius / 2 + margin
    return ObstacleAvoidance(PointRobots(D // 2), [settings.sample.obstacle], reach, _barrier(settings.constraint))


def correction(settings: config.Correction, constraint: Constraint, source: Source) -> Correction:
    """u^c of a constraint, smoothed as the settings say."""
    if settings.smoothing == "covariant":
        return Correction(constraint, covariant(source.covariance))
    smoothing = gaussian_filter(len(source.prior), settings.sigma, settings.width, settings.edges)
    if settings.keep_ends:
        smoothing[source.index] = 0
    return Correction(constraint, smoothing)


def network(settings: config.Network, source: Source, D: int, constraint: Constraint) -> ResMLP | SpectralMLP:
    """The velocity network v_theta."""
    if settings.kind == "spectral":
        return SpectralMLP(source, D, constraint, settings.hidden, settings.blocks)
    return ResMLP(len(source.prior), D, settings.hidden, settings.blocks, settings.sees_ends)


def repaired(settings: Config, x: Tensor) -> Tensor:
    """Demonstrations x (N, T, D), those in collision moved out of it by the margin, along the source's covariance."""
    D = x.shape[2]
    constraint = RobotAvoidance(
        PointRobots(D // 2), settings.constraint.radius + settings.correction.margin, Barrier("relu")
    )
    return repair(x, Correction(constraint, covariant(build_source(settings.source, x.shape[1]).covariance)))


def random_stream(*key: str | int, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator that is a function of what its numbers are for, such as ("batch", seed, step).

    No state is carried from one use to the next, so a run that was interrupted draws what it would have drawn.
    """
    digest = hashlib.sha256(repr(key).encode()).digest()
    return torch.Generator(device).manual_seed(int.from_bytes(digest[:8], "big") >> 1)


def _barrier(settings: config.Constraint) -> Barrier:
    return Barrier(settings.barrier, settings.reduction, settings.gamma)
