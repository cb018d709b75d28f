"""What a few seeds say of a method: intervals that cover, tests that do not find what is not there."""

import math
from itertools import product
from statistics import fmean

import numpy as np
import pytest
import torch
from scipy import stats

from conflow.results.statistics import LEVEL, Score, Seed, difference, differs, holm, mean_interval, rate_interval
from conflow.training.metrics import EnergyDistance, Z, quantile_interval, wilson

REPETITIONS = 2000
NOISE = 3 * math.sqrt(0.95 * 0.05 / REPETITIONS)
"""Three standard deviations of a share near 0.95 or 0.05 of as many."""
CORRELATION = 0.005
"""Between trajectories of one network, as of `cgp` at preset long: 24, 44 and 67 of 2,048."""


def draw(rate: float, correlation: float, seeds: int, total: int, stream: np.random.Generator) -> np.ndarray:
    """Counts (REPETITIONS, seeds) of networks whose own rates are of a beta distribution."""
    shape = (REPETITIONS, seeds)
    if not 0 < rate < 1 or correlation == 0:
        return stream.binomial(total, rate, shape)
    return stream.binomial(total, stream.beta(rate * (1 / correlation - 1), (1 - rate) * (1 / correlation - 1), shape))


def correlations(rate: float) -> tuple[float, ...]:
    """None, and that of `cgp`; of rare rates such that networks differ by the same factor, some 1.5."""
    return (0.0, CORRELATION * min(1, rate / 0.022)) if rate else (0.0,)


def scores(counts: np.ndarray, total: int) -> dict[Seed, Score]:
    return {(seed, None): Score.of_rate(count, total) for seed, count in enumerate(counts)}


@pytest.mark.parametrize(("seeds", "total"), [*product((2, 3, 5), (2048, 10240)), (10, 2048)])
def test_the_interval_over_seeds_covers_the_methods_rate(seeds: int, total: int) -> None:
    stream = np.random.default_rng(0)
    for rate in (0.0, 0.0005, 0.005, 0.022, 0.1, 0.5):
        for correlation in correlations(rate):
            counts = draw(rate, correlation, seeds, total, stream)
            ends = [rate_interval(one.tolist(), [total] * seeds) for one in counts]
            covered = fmean(low <= rate <= high for low, high in ends)
            # 0.95 where rates are frequent; the scale's curvature takes up to 0.02 where seeds differ by half.
            assert covered > 0.93 - NOISE, (rate, correlation)


def test_all_trajectories_together_cover_it_hardly_ever() -> None:
    """Why there are intervals over seeds: they treat 3 networks as 6,144."""
    counts = draw(0.022, CORRELATION, 3, 2048, np.random.default_rng(0)).sum(axis=1)
    ends = [wilson(int(count), 3 * 2048) for count in counts]
    assert fmean(low <= 0.022 <= high for low, high in ends) < 0.5


@pytest.mark.parametrize("counts", [(24, 44, 67), (0, 0, 1), (5, 5), (2048, 2047, 2000), (1024, 1024, 1024)])
def test_the_interval_holds_the_rate_and_what_counting_alone_leaves_open(counts: tuple[int, ...]) -> None:
    totals = [2048] * len(counts)
    low, high = rate_interval(counts, totals)
    pooled = wilson(sum(counts), sum(totals))
    assert low <= pooled[0] < sum(counts) / sum(totals) < pooled[1] <= high
    # What holds for those that collide holds for those that do not.
    mirrored = rate_interval([2048 - count for count in counts], totals)
    assert mirrored == pytest.approx((1 - high, 1 - low), abs=1e-12)


def test_no_collision_in_any_seed_is_as_much_as_one_network_can_say() -> None:
    for totals in ([10_000] * 3, [9_000, 10_000, 11_000]):
        assert rate_interval([0, 0, 0], totals) == pytest.approx(wilson(0, 10_000), rel=1e-12, abs=0)
        assert rate_interval(totals, totals) == pytest.approx(wilson(10_000, 10_000), rel=1e-12, abs=0)


@pytest.mark.parametrize(("count", "total"), [(4, 256), (13, 40), (1, 10_000), (255, 256)])
def test_wilsons_ends_are_where_the_score_test_turns(count: int, total: int) -> None:
    """|count / n - p| = z sqrt(p (1 - p) / n) at both ends p."""
    low, high = wilson(count, total)
    assert low < count / total < high
    for p in (low, high):
        assert abs(count / total - p) == pytest.approx(Z * math.sqrt(p * (1 - p) / total), rel=1e-9)


@pytest.mark.parametrize("total", [20, 256, 500, 2048, 10_240])
@pytest.mark.parametrize("q", [0.5, 0.95])
def test_the_ranks_of_a_quantiles_interval_are_scipys(q: float, total: int) -> None:
    """Of 0, 1, ..., which are their own ranks; SciPy has none above the 0.95-quantile of 20."""
    exact = stats.quantile_test(np.arange(total), q=total * q, p=q).confidence_interval(0.95)
    low, high = quantile_interval(torch.randperm(total, generator=torch.Generator().manual_seed(0)).double(), q)
    assert (low, high) == (exact.low, total - 1 if math.isnan(exact.high) else exact.high)


@pytest.mark.parametrize("total", [21, 500])
def test_the_interval_of_a_median_is_the_same_from_above(total: int) -> None:
    low, high = quantile_interval(torch.arange(total).double(), 0.5)
    assert low + high == total - 1


@pytest.mark.parametrize(("seeds", "total"), [(2, 2048), (3, 2048), (5, 10240)])
def test_a_network_of_the_same_method_seldom_differs(seeds: int, total: int) -> None:
    stream = np.random.default_rng(0)
    for rate in (0.0, 0.004, 0.022, 0.3):
        for correlation in correlations(rate):
            both = draw(rate, correlation, seeds, total, stream), draw(rate, correlation, 1, 256, stream)
            found = [
                differs(list(scores(counts, total).values()), Score.of_rate(int(other[0]), 256))
                for counts, other in zip(*both, strict=True)
            ]
            assert fmean(found) < LEVEL + NOISE, (rate, correlation)


def test_a_rate_that_no_such_network_has_differs() -> None:
    """As 0.035 and 0.31 do; within the spread of the seeds it does not."""
    near, far = Score.of_rate(4, 256), Score.of_rate(80, 256)
    of_cgp = list(scores(np.array([24, 44, 67]), 2048).values())
    assert (differs(of_cgp, near), differs(of_cgp, far)) == (False, True)


def test_seeds_in_common_are_compared_in_pairs_and_others_by_welchs_test() -> None:
    a, b = [0.3, 0.5, 0.9], [0.2, 0.1, 0.6]
    one: dict[Seed, Score] = {(seed, "d"): Score(value) for seed, value in enumerate(a)}
    paired = difference(one, {(seed, "d"): Score(value) for seed, value in enumerate(b)})
    assert paired is not None
    assert paired.p == pytest.approx(stats.ttest_rel(a, b).pvalue)
    assert paired.pairs == 3
    for first, digest in ((5, "d"), (0, "other")):
        welch = difference(one, {(first + seed, digest): Score(value) for seed, value in enumerate(b)})
        assert welch is not None
        assert welch.p == pytest.approx(stats.ttest_ind(a, b, equal_var=False).pvalue)
        assert welch.pairs == 0


@pytest.mark.parametrize(("a", "b"), [((24, 44, 67), (301, 280)), ((24, 25, 26), (30, 31)), ((0, 0), (9, 30, 3))])
def test_welchs_test_with_the_spread_of_counting_is_scipys_from_these_spreads(
    a: tuple[int, ...], b: tuple[int, ...]
) -> None:
    """The spread between seeds, that of counting where it is larger, and one of each."""
    sides = [[Score.of_rate(count, 2048) for count in counts] for counts in (a, b)]
    one: dict[Seed, Score] = {(seed, "a"): score for seed, score in enumerate(sides[0])}
    found = difference(one, {(seed, "b"): score for seed, score in enumerate(sides[1])})
    assert found is not None
    moments = []
    for side in sides:
        theta = [score.value for score in side]
        moments += [fmean(theta), max(float(np.std(theta, ddof=1)), math.sqrt(1 / (4 * 2048 + 2))), len(theta)]
    oracle = stats.ttest_ind_from_stats(*moments, equal_var=False)
    assert found.p == pytest.approx(float(oracle.pvalue), rel=1e-9)
    assert abs(found.a - found.b) / found.error == pytest.approx(abs(float(oracle.statistic)))


def test_without_a_second_seed_or_without_a_spread_there_is_no_test() -> None:
    two: dict[Seed, Score] = {(seed, None): Score(0.1) for seed in range(2)}
    one: dict[Seed, Score] = {(0, None): Score(0.1)}
    assert difference(one, two) is None
    assert difference(two, two) is None


def test_two_methods_that_never_collide_are_alike_however_many_were_counted() -> None:
    """On the scale of the tests 0 of 2,048 is not 0 of 10,000, in every pair by the same: a spread of none."""
    found = difference(scores(np.zeros(3), 2048), scores(np.zeros(3), 10_000))
    assert found is not None
    assert found.p > 0.2


@pytest.mark.parametrize("pairs", [True, False])
def test_methods_of_one_rate_are_seldom_told_apart(pairs: bool) -> None:
    stream = np.random.default_rng(0)
    for rate, seeds in product((0.0005, 0.022, 0.3), (2, 3, 5)):
        for correlation in correlations(rate):
            both = [draw(rate, correlation, seeds, 2048, stream) for _ in "ab"]
            ps = []
            for a, b in zip(*both, strict=True):
                others = {(seed, None if pairs else "other"): score for (seed, _), score in scores(b, 2048).items()}
                found = difference(scores(a, 2048), others)
                assert found is not None
                ps.append(found.p)
            assert fmean(p < LEVEL for p in ps) < LEVEL + NOISE, (rate, seeds, correlation)


def test_what_is_visible_is_where_the_test_turns() -> None:
    a, b = np.array([240, 244, 267]), np.array([572, 603, 578])
    found = difference(scores(a, 2048), scores(b, 2048))
    assert found is not None
    assert found.visible(found.p) == pytest.approx(abs(found.a - found.b))
    # Back on the scale of rates: 0.122 against 0.285.
    assert found.visible_rate(found.p) == pytest.approx((b.sum() - a.sum()) / (3 * 2048), rel=1e-3)
    assert found.visible(0.001) > found.visible(0.05)


def test_holms_correction_worked_by_hand() -> None:
    """0.005 x 4, 0.01 x 3, 0.03 x 2, and 0.04 x 1 which is not below the one before."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


def test_the_mean_energy_distance_covers_though_all_seeds_share_a_reference() -> None:
    """Standard normals in one dimension, a reference of 40 for three networks of 200 samples, one standard normal off.

    A t interval over the seeds alone does not see the error of the reference, and taking the seeds' errors as
    independent makes it too small.
    """
    truth = 2 * stats.foldnorm.mean(1 / math.sqrt(2), scale=math.sqrt(2)) - 4 / math.sqrt(math.pi)
    generator = torch.Generator().manual_seed(0)
    mended: list[bool] = []
    alone: list[bool] = []
    independent: list[bool] = []
    for _ in range(400):
        reference = torch.randn(40, 1, 1, generator=generator)
        results = []
        for _ in range(3):
            metric = EnergyDistance(reference)
            metric.update(torch.randn(200, 1, 1, generator=generator) + 1)
            results.append(metric.compute())
        values = [result["energy_distance"] for result in results]
        reach = fmean(result["energy_distance_high"] - result["energy_distance"] for result in results)
        for found, shared in ((mended, reach), (alone, 0.0)):
            low, high = mean_interval(values, shared, shared)
            found.append(low <= truth <= high)
        independent.append(abs(fmean(values) - truth) <= reach / math.sqrt(3))
    # Four standard deviations of a share of 400 are 0.044; each seed's own part is in both of the terms.
    assert fmean(mended) > 0.93
    assert fmean(alone) < 0.9
    assert fmean(independent) < 0.9


def test_without_a_shared_error_the_interval_of_a_mean_is_students() -> None:
    values = [0.1, 0.4, 0.3, 0.9]
    oracle = stats.ttest_1samp(values, 0).confidence_interval(0.95)
    assert mean_interval(values, 0, 0) == pytest.approx((oracle.low, oracle.high))
    # A shared one of 3 beside the seeds' own of 4 makes 5.
    half = (oracle.high - oracle.low) / 2
    low, high = mean_interval(values, 0, 3 / 4 * half)
    assert (fmean(values) - low, high - fmean(values)) == pytest.approx((half, 5 / 4 * half))
