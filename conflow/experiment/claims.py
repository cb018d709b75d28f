"""The paper's claims, and ours, in words: what the runs say to each."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from scipy import stats

from conflow.experiment.cells import COLLISIONS, LEVEL, QUALITIES, cell, digits, fisher_p, per_seed
from conflow.experiment.record import Record

Verdict = Literal[
    "holds",
    "reversed",
    "holds for these networks",
    "reversed for these networks",
    "not distinguishable",
    "too few seeds",
    "no runs",
]


@dataclass(frozen=True)
class Claim:
    """A sentence "a is lower than b", and what the runs say to it.

    Attributes:
        verdict: of a rate by Fisher's exact test on the counts, "for these networks" where the test between seeds does
            not say the same; of anything else by the test between seeds.
        p: of Fisher's exact test, of a rate. It speaks of the networks that were trained, not of others.
        seeds_p: of Welch's t test on the values of the seeds; none where there are too few to have a spread.
    """

    text: str
    verdict: Verdict
    p: float | None
    seeds_p: float | None
    detail: str


def claims(runs: Mapping[str, list[Record]]) -> list[Claim]:
    """Each as "a is lower than b"; none where there are no runs at all."""
    if not runs:
        return []
    none, *_ = COLLISIONS
    rates = [
        ("ConFlow collides less than FM, without guidance", "cgp", "fm", none),
        *(
            (f"negatives help ConFlow ({column})", "cgp", "no_negatives", metric)
            for metric, column in list(COLLISIONS.items())[:4]
        ),
        ("naive negatives hurt FM, without guidance", "fm", "fm_mixed", none),
        ("CGP beats Gaussian: collision rate", "cgp", "gaussian", none),
    ]
    others = [(metric, row) for metric, row in QUALITIES.items() if metric != none]
    ours = [
        ("the spectral network lets ConFlow collide less, without guidance", "spectral", "cgp", none),
        ("plus collides less than ConFlow, without guidance", "plus", "cgp", none),
        ("plus collides less than ConFlow (D+), without guidance", "plus", "no_negatives", none),
    ]
    return [
        *(_compare(runs, *claim) for claim in rates),
        *(_compare(runs, f"CGP beats Gaussian: {row}", "cgp", "gaussian", key) for key, row in others),
        *(_compare(runs, *claim) for claim in ours),
    ]


def _compare(runs: Mapping[str, list[Record]], text: str, lower: str, higher: str, metric: str) -> Claim:
    if lower not in runs or higher not in runs:
        missing = " and ".join(name for name in (lower, higher) if name not in runs)
        return Claim(text, "no runs", None, None, f"no finished run of {missing}")
    a, b = (cell("", "", "", None, metric, runs[name]) for name in (lower, higher))
    if a is None or b is None:
        return Claim(text, "no runs", None, None, f"not all runs of {lower} and {higher} have {metric}")
    seeds_p = _welch_p(per_seed(metric, runs[lower]), per_seed(metric, runs[higher]))
    p = None
    if a.count is not None and b.count is not None:
        p = fisher_p(a.count, a.trajectories, b.count, b.trajectories)
    detail = f"{digits(a.value)} against {digits(b.value)}, {a.seeds} and {b.seeds} seeds"
    return Claim(text, _verdict(a.value < b.value, p, seeds_p), p, seeds_p, detail)


def _verdict(lower: bool, p: float | None, seeds_p: float | None) -> Verdict:
    """On "a is lower than b", where it is or is not.

    Args:
        lower: whether a's value is.
        p: of the exact test, of a rate.
        seeds_p: of the test between seeds, unless there are too few.
    """
    deciding = seeds_p if p is None else p
    if deciding is None:
        return "too few seeds"
    if deciding >= LEVEL:
        return "not distinguishable"
    if seeds_p is None or seeds_p >= LEVEL:
        return "holds for these networks" if lower else "reversed for these networks"
    return "holds" if lower else "reversed"


def _welch_p(a: Sequence[float], b: Sequence[float]) -> float | None:
    """The p of Welch's t test, or None where one side is a single value or neither has a spread."""
    if min(len(a), len(b)) < 2 or len(set(a)) == len(set(b)) == 1:
        return None
    moments = [moment for side in (a, b) for moment in (statistics.mean(side), statistics.stdev(side), len(side))]
    return float(stats.ttest_ind_from_stats(*moments, equal_var=False).pvalue)
