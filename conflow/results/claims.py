"""The paper's claims, and ours, in words: what the runs say to each."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from conflow.results import paper, statistics
from conflow.results.records import Record
from conflow.results.statistics import LEVEL, Difference
from conflow.results.tables import COLLISIONS, QUALITIES, cell, collisions, scores
from conflow.training.summary import digits

Verdict = Literal["holds", "reversed", "not distinguishable", "too few seeds", "no runs"]


@dataclass(frozen=True)
class Claim:
    """A sentence "a is lower than b", and what the runs say to it.

    Attributes:
        verdict: by the corrected p.
        p: of the t test between seeds, in pairs where two seeds or more are common; none where it cannot be made.
        corrected_p: by Holm's correction for all claims that are printed together.
        unseen: where not distinguishable, the least difference that would have been seen, at the spread of these
            seeds and with that correction.
    """

    text: str
    verdict: Verdict
    p: float | None
    corrected_p: float | None
    unseen: float | None
    detail: str


def claims(runs: Mapping[str, list[Record]], readings: Iterable[list[Record]] = ()) -> list[Claim]:
    """Each as "a is lower than b"; none where there are no runs at all.

    Args:
        runs: by ablation, a run for each seed.
        readings: the rows of changed settings. Where ConFlow was trained with and without negatives under another
            reading of the paper, the claim that they help is made for that one as well.
    """
    if not runs or collisions(runs) is not COLLISIONS:  # a task of its own has claims of its own
        return []
    none, robot, *_ = COLLISIONS
    nearer = ("test/robot/energy_distance", "test/none/energy_distance")
    rates = [
        ("ConFlow collides less than FM, without guidance", "cgp", "fm", none),
        *_negatives_help(),
        ("naive negatives hurt FM, without guidance", "fm", "fm_mixed", none),
        ("CGP beats Gaussian: collision rate", "cgp", "gaussian", none),
    ]
    others = [(metric, row) for metric, row in QUALITIES.items() if metric != none]
    ours = [
        # On D+ alone nothing is corrected, so what it is compared with is the same for every correction.
        ("negatives help ConFlow with the covariant correction, without guidance", "covariant", "no_negatives", none),
        ("the spectral network lets ConFlow collide less, without guidance", "spectral", "cgp", none),
        ("plus collides less than ConFlow, without guidance", "plus", "cgp", none),
        ("plus collides less than ConFlow (D+), without guidance", "plus", "no_negatives", none),
        ("guided by descent, D+ alone collides less than plus without guidance", "descent", "plus", robot, none),
        ("guided by descent, D+ alone is nearer to held-out D+ than plus without guidance", "descent", "plus", *nearer),
    ]
    ordered = [*rates, *((f"CGP beats Gaussian: {row}", "cgp", "gaussian", key) for key, row in others), *ours]
    compared = [_compared(runs, *claim) for claim in ordered]
    for reading, of_reading in _other_readings(readings).items():
        compared += [_compared(of_reading, *claim) for claim in _negatives_help(f", {reading}")]
    return _judged(compared)


def _negatives_help(reading: str = "") -> list[tuple[str, str, str, str]]:
    """The claim in each of the paper's columns."""
    columns = list(COLLISIONS.items())[:4]
    text = "negatives help ConFlow"
    return [(f"{text} ({column}){reading}", "cgp", "no_negatives", metric) for metric, column in columns]


def _other_readings(rows: Iterable[list[Record]]) -> dict[str, dict[str, list[Record]]]:
    """The runs of both ablations that the claim is of, by reading; those of a seed's second precision left out."""
    found: dict[str, dict[str, list[Record]]] = {}
    for of_row in rows:
        changed = [change.partition("=")[0] for change in of_row[0].reading]
        if changed and all(name in paper.OPEN for name in changed):
            found.setdefault(" ".join(of_row[0].reading), {}).setdefault(of_row[0].ablation, of_row)
    return {reading: of_reading for reading, of_reading in found.items() if {"cgp", "no_negatives"} <= {*of_reading}}


def _compared(
    runs: Mapping[str, list[Record]], text: str, lower: str, higher: str, metric: str, of_higher: str | None = None
) -> tuple[Claim, Difference | None, bool]:
    """A claim as it is before the test, the difference that decides it, if any, and whether that is of rates."""
    if lower not in runs or higher not in runs:
        missing = " and ".join(name for name in (lower, higher) if name not in runs)
        return _undecided(text, "no runs", f"no finished run of {missing}"), None, False
    metrics = {lower: metric, higher: of_higher or metric}
    a, b = (cell("", "", "", None, key, runs[name]) for name, key in metrics.items())
    if a is None or b is None:
        wanted = " and ".join(dict.fromkeys(key.removeprefix("test/") for key in metrics.values()))
        reason = f"not all runs of {lower} and {higher} have {wanted}"
        return _undecided(text, "no runs", reason), None, False
    between = statistics.difference(*(scores(key, runs[name]) for name, key in metrics.items()))
    detail = f"{digits(a.value)} against {digits(b.value)}, {a.seeds} and {b.seeds} seeds"
    if between is not None and between.pairs:
        detail += f", {between.pairs} in pairs"
    return _undecided(text, "too few seeds", detail), between, a.count is not None


def _undecided(text: str, verdict: Verdict, detail: str) -> Claim:
    return Claim(text, verdict, None, None, None, detail)


def _judged(compared: Sequence[tuple[Claim, Difference | None, bool]]) -> list[Claim]:
    """The claims with their verdicts, corrected for all that are tested."""
    tested = [i for i, (_, between, _) in enumerate(compared) if between is not None]
    ps = [between.p for _, between, _ in compared if between is not None]
    corrected = statistics.holm(ps)
    # What Holm asks of the smallest p that it does not reject, and so of all that are not.
    level = LEVEL / max(1, sum(p >= LEVEL for p in corrected))
    judged = [claim for claim, _, _ in compared]
    for i, p, corrected_p in zip(tested, ps, corrected, strict=True):
        claim, between, of_rates = compared[i]
        assert between is not None
        seen = corrected_p < LEVEL
        verdict: Verdict = "not distinguishable" if not seen else "holds" if between.a < between.b else "reversed"
        unseen = None if seen else between.visible_rate(level) if of_rates else between.visible(level)
        judged[i] = replace(claim, verdict=verdict, p=p, corrected_p=corrected_p, unseen=unseen)
    return judged
