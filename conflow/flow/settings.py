"""The settings of this room: source, correction, network and sampling. Without torch, to be quick.

A range beside a type is what the setting may be: from `low` to `high`, or `above`.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

SourceKind = Literal["gaussian", "gp", "cgp"]
NetworkKind = Literal["resmlp", "spectral", "attention"]
Smoothing = Literal["filter", "covariant"]
Edges = Literal["zero", "nearest", "normalised"]
Place = Literal["point", "end"]
Mask = Literal["violates", "feasible"]
PathKind = Literal["linear", "guided"]
Solver = Literal["euler", "midpoint", "rk4"]
Guidance = Literal["point", "end", "descent"]

Weight = Annotated[float, {"low": 0, "high": 1e9}]
# Their squares and inverses must stay numbers, also in single precision.
Scale = Annotated[float, {"low": 1e-6, "high": 1e6}]


@dataclass(frozen=True)
class Source:
    kind: SourceKind
    length_scale: Scale
    sigma_f: Scale
    epsilon: Annotated[float, {"low": 1e-12, "high": 1e6}]
    modes: Annotated[int | None, {"low": 1, "high": 4096}]
    fit: bool


@dataclass(frozen=True)
class Correction:
    lambda_c: Weight
    mask: Mask
    at: Place
    ramp: Annotated[float, {"low": 0, "high": 100}]
    path: PathKind
    margin: Annotated[float, {"low": 0, "high": 1}]
    walls: bool
    smoothing: Smoothing
    sigma: Scale
    width: Annotated[int, {"low": 1, "high": 8191}]
    edges: Edges
    keep_ends: bool


@dataclass(frozen=True)
class Network:
    kind: NetworkKind
    hidden: Annotated[int, {"low": 1, "high": 65536}]
    blocks: Annotated[int, {"low": 0, "high": 1024}]
    sees_ends: bool
