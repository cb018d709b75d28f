"""What the runs of a few seeds say of a method: intervals over seeds, differences of methods, one more network.

A seed is one network. Its trajectories say how good that network is; only other seeds say how good another network of
the same method would be. Rates are compared on Anscombe's scale, theta = arcsin sqrt((c + 3/8) / (n + 3/4)) of c of n
trajectories: there counting alone gives a variance of 1 / (4 n + 2) at every rate. The spread of seeds is never taken
below that, since a few seeds may be close to each other by luck.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from statistics import fmean, variance

from scipy import stats

from conflow.training.metrics import Z, wilson

LEVEL = 0.05
"""Rates differ and claims are decided at this level, two-sided; intervals are of 95 %."""
PAIRS = 2
"""Methods are compared in pairs of seeds where there are as many."""
Seed = tuple[int, str | None]
"""A seed's number and the digest of its demonstrations: methods that share both begin from the same."""


@dataclass(frozen=True)
class Score:
    """What one network reached, on the scale that tests are made on.

    Attributes:
        value: theta of a rate; of anything else the metric itself.
        noise: the variance that counting gives to it; 0 where nothing is counted.
    """

    value: float
    noise: float = 0.0

    @classmethod
    def of_rate(cls, count: float, total: float) -> "Score":
        """Anscombe's theta of a count, and its variance by counting."""
        return cls(math.asin(math.sqrt((count + 3 / 8) / (total + 3 / 4))), 1 / (4 * total + 2))


def rate_interval(counts: Sequence[int], totals: Sequence[int]) -> tuple[float, float]:
    """The interval of a method's mean rate, from the counts of two or more seeds.

    sin^2(mean theta -+ t s / sqrt k) of k seeds, with t of k - 1 degrees of freedom, and never less than Wilson's of
    all trajectories together. Where none or all are counted, seeds cannot show what they differ by: then it is
    Wilson's of one network, whose other end is z^2 / (n + z^2) away from 0 or 1. Its n trajectories are the mean of the
    seeds', which need not be whole as SciPy's must.

    Args:
        counts: how many trajectories of each seed it holds for, (k,).
        totals: of how many, (k,).
    """
    k, count, total = len(counts), sum(counts), sum(totals)
    if count in (0, total):
        reach = Z**2 / (total / k + Z**2)
        return (0.0, reach) if count == 0 else (1 - reach, 1.0)
    scores = [Score.of_rate(*one) for one in zip(counts, totals, strict=True)]
    centre, half = fmean(score.value for score in scores), _quantile(k - 1) * _spread(scores) / math.sqrt(k)
    low, high = (math.sin(min(max(end, 0), math.pi / 2)) ** 2 for end in (centre - half, centre + half))
    pooled_low, pooled_high = wilson(count, total)
    return min(low, pooled_low), max(high, pooled_high)


def mean_interval(values: Sequence[float], below: float, above: float) -> tuple[float, float]:
    """The t interval of the mean of two or more seeds.

    Args:
        values: of the seeds.
        below: how far an error that all seeds share reaches, half of an interval of its own. It is independent of what
            the seeds differ by, so they add up in squares, and more seeds do not make it smaller.
        above: the same on the upper side.
    """
    mean, half = fmean(values), _quantile(len(values) - 1) * math.sqrt(variance(values) / len(values))
    return mean - math.hypot(half, below), mean + math.hypot(half, above)


def differs(scores: Sequence[Score], other: Score) -> bool:
    """Whether a rate is another than one new network of the method would reach, at `LEVEL`.

    |mean theta - other theta| is beyond the squares' sum of t s sqrt(1 + 1/k), for the k seeds, two or more, and the
    new one, and of z sqrt(v - v_k), with v the other's variance by counting, and v_k that of a seed, which s has.
    """
    seeds = _quantile(len(scores) - 1) * _spread(scores) * math.sqrt(1 + 1 / len(scores))
    counting = Z * math.sqrt(max(other.noise - fmean(score.noise for score in scores), 0))
    return abs(fmean(score.value for score in scores) - other.value) > math.hypot(seeds, counting)


@dataclass(frozen=True)
class Difference:
    """Between two methods, on the scale of their scores.

    Attributes:
        a, b: their means over seeds.
        error: the standard error of a - b.
        freedom: its degrees of freedom.
        pairs: how many seeds were compared in pairs; 0 for none.
    """

    a: float
    b: float
    error: float
    freedom: float
    pairs: int

    @property
    def p(self) -> float:
        """Of the t test of no difference, two-sided."""
        return float(2 * stats.t.sf(abs(self.a - self.b) / self.error, self.freedom))

    def visible(self, level: float) -> float:
        """The least |a - b| that the test sees at a level, with these standard errors."""
        return _quantile(self.freedom, level) * self.error

    def visible_rate(self, level: float) -> float:
        """The same as a difference of rates, around the mean of both: sin^2 a - sin^2 b = sin(a + b) sin(a - b)."""
        return math.sin(self.a + self.b) * math.sin(min(self.visible(level), math.pi / 2))


def difference(a: Mapping[Seed, Score], b: Mapping[Seed, Score]) -> Difference | None:
    """Of two methods by their seeds, or None where there are too few to have a spread.

    Those that both methods have are compared in pairs where there are `PAIRS` of them, otherwise all by Welch's test.
    Neither takes a spread below that of counting alone. SciPy's `ttest_ind_from_stats` has the same p for such spreads,
    but keeps the standard error and the degrees of freedom to itself, which `Difference.visible` needs.
    """
    common = [seed for seed in a if seed in b]
    paired = len(common) >= PAIRS
    sides = [[side[seed] for seed in common] if paired else list(side.values()) for side in (a, b)]
    if min(map(len, sides)) < 2:
        return None
    pairs = [Score(x.value - y.value, x.noise + y.noise) for x, y in zip(*sides, strict=paired)]
    parts = [_spread(one) ** 2 / len(one) for one in ([pairs] if paired else sides)]
    if sum(parts) == 0:
        return None
    # Satterthwaite's; of one part, the pairs, it is their number less one.
    freedom = sum(parts) ** 2 / sum(part**2 / (len(side) - 1) for part, side in zip(parts, sides, strict=False))
    mean_a, mean_b = (fmean(score.value for score in side) for side in sides)
    return Difference(mean_a, mean_b, math.sqrt(sum(parts)), freedom, len(common) if paired else 0)


def holm(ps: Sequence[float]) -> list[float]:
    """Holm's corrected p of tests that are read together: the chance of one false rejection among them is at most it.

    The i-th smallest of m is multiplied by m - i + 1, and none is smaller than the one before it. SciPy has corrections
    for the rate of false discoveries, but not this one.
    """
    corrected, last = [0.0] * len(ps), 0.0
    for rank, i in enumerate(sorted(range(len(ps)), key=lambda i: ps[i])):
        last = max(last, min(1.0, (len(ps) - rank) * ps[i]))
        corrected[i] = last
    return corrected


def _spread(scores: Sequence[Score]) -> float:
    """The standard deviation between seeds, at least that of counting."""
    between = variance(score.value for score in scores)
    return math.sqrt(max(between, fmean(score.noise for score in scores)))


@cache
def _quantile(freedom: float, level: float = LEVEL) -> float:
    """Of Student's t, two-sided."""
    return float(stats.t.isf(level / 2, freedom))
