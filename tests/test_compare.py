import csv
import io
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args

import pytest
from mlflow.entities import Metric, Param
from rich.console import Console
from scipy import stats

from conflow.errors import ConfigError
from conflow.results import printing
from conflow.results.comparison import Comparison, collect
from conflow.results.statistics import LEVEL, holm, rate_interval
from conflow.results.tables import COLLISIONS, GUARDS, METHODS, QUALITIES, Cell
from conflow.tracking import code, store
from conflow.training import config
from conflow.training.metrics import wilson
from tests.conftest import Command

MEASURED = tuple(f"{split}/{setting}" for split in ("test", "validation") for setting in ("none", "robot", "obstacle"))
GROUPS = (*MEASURED, *(f"without_model/{of}" for of in ("data", "feasible", "source")))
RATES = ("robot_collision", "object_collision", "success", "outside", "near")
OTHERS = {key.rsplit("/", 1)[1] for key in (*QUALITIES, *GUARDS)} - {*RATES}


def add_run(
    ablation: str,
    seed: int,
    counts: int,
    quality: float,
    *arguments: str,
    status: str = "FINISHED",
    lacking: tuple[str, ...] = (),
    by: Mapping[str, str] | None = None,
    groups: Sequence[str] = GROUPS,
) -> str:
    """A run as training leaves it, with the same count of 1,000 trajectories in every setting, one more on test.

    It was logged before there were the metrics that it is `lacking`, `by` the code of these tags or the present one.
    """
    client = store.client()
    experiment = client.get_experiment_by_name("conflow")
    assert experiment is not None
    settings = config.load(["preset=smoke", f"ablation={ablation}", f"seed={seed}", *arguments])
    tags = {"ablation": ablation, "preset": "smoke", "seed": str(seed), "config_sha": settings.sha()}
    tags |= code.tags() if by is None else by
    run_id = client.create_run(experiment.experiment_id, run_name=f"{ablation}-s{seed}", tags=tags).info.run_id
    values: dict[str, float] = {}
    for group in groups:
        values |= {f"{group}/num": 1000}
        values |= {f"{group}/{name}_count": counts for name in RATES if name not in lacking}
        values |= {f"{group}/{name}": quality for name in OTHERS if name not in lacking}
    values.pop("without_model/feasible/energy_distance", None)
    values |= {key: value + 1 for key, value in values.items() if key.startswith("test/") and key.endswith("_count")}
    client.log_batch(run_id, metrics=[Metric(key, value, 0, 0) for key, value in values.items()])
    client.set_terminated(run_id, status)
    return str(run_id)


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
        monkeypatch.chdir(tmp_path_factory.mktemp("compared"))
        for seed in range(4):
            add_run("cgp", seed, 20 + seed, 0.01 + 0.001 * seed)
            add_run("fm", seed, 40, 0.1)
            add_run("fm_mixed", seed, 39, 0.1)
            add_run("gaussian", seed, 10, 0.1 + 0.002 * seed)
        add_run("cgp", 3, 999, 9.0, "train.max_steps=7")  # another config
        add_run("cgp", 3, 999, 9.0, status="FAILED")
        return collect("smoke")


def cell(comparison: Comparison, table: str, row: str, column: str) -> Cell:
    (found,) = [c for c in comparison.cells if (c.table, c.row, c.column) == (table, row, column)]
    return found


def test_rates_are_pooled_over_the_seeds_of_this_config_alone(comparison: Comparison) -> None:
    found = cell(comparison, "1", "ConFlow (D+ and D-)", "none: robot")
    assert (found.count, found.trajectories, found.seeds) == (20 + 21 + 22 + 23, 4000, 4)
    assert (found.within_low, found.within_high) == wilson(86, 4000)
    assert (found.low, found.high) == rate_interval([20, 21, 22, 23], [1000] * 4)
    assert found.value == 86 / 4000
    assert (found.seed_low, found.seed_high) == (0.020, 0.023)
    assert found.paper == 0.016


def test_other_metrics_are_means_over_seeds(comparison: Comparison) -> None:
    found = cell(comparison, "2", "smoothness, median", "ConFlow (D+ and D-)")
    assert found.value == pytest.approx(0.0115)
    assert (found.seed_low, found.seed_high) == pytest.approx((0.010, 0.013))
    oracle = stats.ttest_1samp([0.010, 0.011, 0.012, 0.013], 0).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((oracle.low, oracle.high))


def test_the_data_are_counted_once_and_the_source_for_every_seed(comparison: Comparison) -> None:
    assert cell(comparison, "1", "no model: test data", "none: robot").trajectories == 1000
    source = cell(comparison, "1", "no model: source cgp", "none: robot")
    assert source.trajectories == 4000
    # Without a network between them, trajectories of several seeds are as independent as those of one.
    assert source.interval == wilson(86, 4000)


def test_claims_are_judged_between_seeds_and_corrected_together(comparison: Comparison) -> None:
    claims = {claim.text: claim for claim in comparison.claims}
    fm = claims["ConFlow collides less than FM, without guidance"]
    # Pairs of seeds differ less than by counting, whose variances add up: 2 / (4 n + 2) of the difference.
    theta = [[math.asin(math.sqrt((c + 3 / 8) / 1000.75)) for c in counts] for counts in ((20, 21, 22, 23), [40] * 4)]
    t = (statistics.mean(theta[1]) - statistics.mean(theta[0])) / math.sqrt(2 / 4002 / 4)
    assert fm.p == pytest.approx(2 * stats.t.sf(t, 3))
    smoothness = claims["CGP beats Gaussian: smoothness, median"]
    assert smoothness.verdict == "holds"
    paired = stats.ttest_rel([0.010, 0.011, 0.012, 0.013], [0.100, 0.102, 0.104, 0.106])
    assert smoothness.p == pytest.approx(paired.pvalue)
    assert claims["CGP beats Gaussian: collision rate"].detail == "0.0215 against 0.0100, 4 and 4 seeds, 4 in pairs"
    assert claims["negatives help ConFlow (none: robot)"].verdict == "no runs"
    tested = [claim for claim in comparison.claims if claim.p is not None]
    assert [claim.corrected_p for claim in tested] == pytest.approx(holm([claim.p or 0 for claim in tested]))
    for claim in tested:
        assert claim.corrected_p is not None
        assert (claim.corrected_p < LEVEL) == (claim.verdict in ("holds", "reversed"))


def test_a_claim_that_is_not_decided_says_what_could_have_been_seen(comparison: Comparison) -> None:
    """More than what was found; and a little more than that would have been decided after the correction."""
    undecided = [claim for claim in comparison.claims if claim.verdict == "not distinguishable"]
    assert [claim.text for claim in undecided] == [
        "ConFlow collides less than FM, without guidance",
        "naive negatives hurt FM, without guidance",
        "CGP beats Gaussian: collision rate",
    ]
    for claim in undecided:
        a, b = (float(word) for word in claim.detail.replace(",", "").split()[:3:2])
        assert claim.unseen is not None
        assert abs(a - b) < claim.unseen < 0.1
    assert all(claim.unseen is None for claim in comparison.claims if claim not in undecided)


def test_one_seed_says_nothing_of_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    add_run("cgp", 0, 10, 0.01)
    add_run("gaussian", 0, 100, 0.9)
    add_run("gaussian", 1, 100, 0.9)
    found = collect("smoke")
    claims = {claim.text: claim for claim in found.claims}
    for text in ("CGP beats Gaussian: smoothness, median", "CGP beats Gaussian: collision rate"):
        assert (claims[text].verdict, claims[text].p) == ("too few seeds", None)
    alone = cell(found, "1", "ConFlow (D+ and D-)", "none: robot")
    assert (alone.low, alone.high, alone.differs) == (None, None, None)
    assert alone.interval == wilson(10, 1000)
    text = rendered(found, "markdown")
    low, high = wilson(10, 1000)
    assert f"0.0100, within this network [{low:.4f}, {high:.4f}]<br>10 of 1000<br>paper 0.016, one seed: not" in text


def test_seeds_that_differ_more_than_the_methods_decide_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though 510 of 3,000 against 670 of 3,000 trajectories would."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    for seed, (conflow, fm) in enumerate([(10, 100), (300, 310), (200, 260)]):
        add_run("cgp", seed, conflow, 0.01)
        add_run("fm", seed, fm, 0.01)
    claims = {claim.text: claim for claim in collect("smoke").claims}
    found = claims["ConFlow collides less than FM, without guidance"]
    assert found.p is not None
    assert found.p > 0.05
    assert found.verdict == "not distinguishable"


def test_runs_that_cannot_have_these_arguments_are_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    add_run("cgp", 0, 10, 0.01, "correction.keep_ends=true")
    add_run("covariant", 0, 10, 0.01)  # which has no ends to keep
    found = collect("smoke", ["correction.keep_ends=true"])
    assert found.runs.keys() == {"cgp"}


def rendered(comparison: Comparison, form: printing.Format) -> str:
    console = Console(width=160, record=True, file=open("/dev/null", "w"))  # noqa: PTH123, SIM115
    printing.render([comparison], form, console)
    return console.export_text()


def test_json_holds_everything_and_csv_every_cell(comparison: Comparison) -> None:
    tree: Mapping[str, list[dict[str, object]]] = json.loads(rendered(comparison, "json"))
    assert len(tree["cells"]) == len(comparison.cells)
    assert tree["cells"][0]["value"] == comparison.cells[0].value
    lines = rendered(comparison, "csv").splitlines()
    assert len([line for line in lines if line.strip()]) == 1 + len(comparison.cells)


@pytest.mark.parametrize("form", ["table", "markdown"])
def test_a_rate_is_never_shown_without_interval_seeds_and_count(comparison: Comparison, form: printing.Format) -> None:
    text = rendered(comparison, form)
    low, high = rate_interval([20, 21, 22, 23], [1000] * 4)
    for shown in (f"0.0215 [{low:.4f}, {high:.4f}]", "86 of 4000", "paper 0.016, not", "4 seeds, 4000 traj"):
        assert shown in text


def test_every_column_of_the_papers_first_table_has_its_cell(comparison: Comparison) -> None:
    columns = {c.column for c in comparison.cells if c.table == "1" and c.row == "ConFlow (D+ and D-)"}
    assert columns == set(COLLISIONS.values())


def test_what_is_missing_of_the_papers_methods_is_named(comparison: Comparison) -> None:
    said = "Of the paper's methods there is no finished run of ConFlow (D+)"
    assert said in rendered(comparison, "markdown").splitlines()
    of_other_task = replace(comparison, task="social")
    assert said not in rendered(of_other_task, "markdown")
    without_its_rows = replace(comparison, cells=[one for one in comparison.cells if one.without_model])
    assert said not in rendered(without_its_rows, "markdown")


def test_table_3_guards_every_ablation_and_what_no_model_touched(comparison: Comparison) -> None:
    rows: dict[str, list[str]] = {}
    for each in comparison.cells:
        if each.table == "3":
            rows.setdefault(each.row, []).append(each.column)
    guards = list(GUARDS.values())
    feasible = rows.pop("no model: feasible test data")
    assert feasible == [column for metric, column in GUARDS.items() if "none/" in metric and "energy" not in metric]
    sources = {"no model: source cgp", "no model: source gaussian"}
    methods = {"ConFlow (D+ and D-)", "FM (D+)", "FM (D+ and D-)", "ConFlow, Gaussian source"}
    assert rows.keys() == methods | sources | {"no model: test data"}
    # Guided there are models alone.
    unguided = [column for metric, column in GUARDS.items() if "none/" in metric]
    assert all(columns == (guards if row in methods else unguided) for row, columns in rows.items())
    success = cell(comparison, "3", "ConFlow (D+ and D-)", "success rate")
    assert (success.count, success.within_low, success.within_high) == (86, *wilson(86, 4000))
    energy = cell(comparison, "3", "ConFlow (D+ and D-)", "energy distance to held-out D+")
    assert (energy.value, energy.seed_low, energy.seed_high) == pytest.approx((0.0115, 0.010, 0.013))
    assert (energy.count, energy.within_low) == (None, None)


@pytest.fixture(scope="module")
def patchy(tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """Runs of three versions: the oldest first in the table, and one seed of the second that is old."""
    guards = ("energy_distance", "path_length_median", "success", "outside", "near")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
        monkeypatch.chdir(tmp_path_factory.mktemp("patchy"))
        monkeypatch.setitem(METHODS, "removed", "an ablation whose file is gone, with a run")
        store.client().set_tag(add_run("cgp", 7, 10, 0.1), "ablation", "removed")
        for seed in range(2):
            add_run("cgp", seed, 20, 0.01, lacking=(*guards, "smoothness_median", "robot_collision"))
            add_run("fm", seed, 40, 0.1, lacking=guards if seed else ())
            add_run("gaussian", seed, 30, 0.2)
        return collect("smoke")


def test_a_metric_that_a_run_lacks_leaves_its_cells_out_and_no_others(patchy: Comparison) -> None:
    columns = {row: [c.column for c in patchy.cells if (c.table, c.row) == ("3", row)] for row in METHODS.values()}
    assert columns["ConFlow (D+ and D-)"] == ["diversity"]
    assert columns["FM (D+)"] == ["robot-collision rate", "diversity", "smoothness, median"]
    assert columns["ConFlow, Gaussian source"] == list(GUARDS.values())
    # The data are the same for all, so any run that measured them will do.
    assert cell(patchy, "3", "no model: test data", "success rate").count == 40


def test_a_claim_on_a_metric_that_a_run_lacks_says_so(patchy: Comparison) -> None:
    claims = {claim.text: claim for claim in patchy.claims}
    found = claims["CGP beats Gaussian: smoothness, median"]
    assert (found.verdict, found.p) == ("no runs", None)
    assert found.detail == "not all runs of cgp and gaussian have none/smoothness_median"
    assert claims["CGP beats Gaussian: start error per robot"].verdict != "no runs"


@pytest.mark.parametrize("form", ["table", "markdown", "csv", "json"])
def test_missing_cells_are_blank_in_every_format(patchy: Comparison, form: printing.Format) -> None:
    text = rendered(patchy, form)
    if form == "markdown":
        _, table_3 = text.split("**Table 3")
        header, _, old, *_ = [line.split("|")[1:-1] for line in table_3.splitlines() if line.startswith("|")]
        # In the order of the metrics, although the first row has the third alone.
        assert [name.strip() for name in header[1:]] == [*GUARDS.values(), printing.AGAIN]
        assert [bool(value.strip()) for value in old[1:-1]] == [name == "diversity" for name in GUARDS.values()]
    elif form == "csv":
        first, *_ = text.split("\n\n")
        assert len(list(csv.DictReader(io.StringIO(first)))) == len(patchy.cells)
    elif form == "json":
        assert len(json.loads(text)["cells"]) == len(patchy.cells)


@pytest.mark.parametrize("form", get_args(printing.Format))
def test_without_a_single_cell_the_claims_are_left(comparison: Comparison, form: printing.Format) -> None:
    text = rendered(replace(comparison, cells=[], reasons={}), form)
    assert "table,row" in text if form == "csv" else "no finished run of plus" in text
    assert "Table" not in text


def test_plus_is_compared_with_both_of_the_papers_methods(comparison: Comparison) -> None:
    claims = {claim.text: claim for claim in comparison.claims}
    found = claims["plus collides less than ConFlow (D+), without guidance"]
    assert (found.verdict, found.detail) == ("no runs", "no finished run of plus and no_negatives")
    assert claims["plus collides less than ConFlow, without guidance"].detail == "no finished run of plus"


def test_a_readable_name_without_an_ablation_does_no_harm(patchy: Comparison) -> None:
    assert patchy.runs.keys() == {"cgp", "fm", "gaussian"}


def test_without_runs_the_way_to_some_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        ConfigError, match=r"preset=paper: no such run has finished in runs/mlflow\.db; try: make ablations"
    ):
        collect("paper")


def test_runs_of_the_present_code_come_before_newer_ones_and_others_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    other = {name: value.replace("flow/path.py:", "flow/path.py:0") for name, value in code.tags().items()}
    add_run("cgp", 0, 10, 0.01)
    add_run("cgp", 0, 900, 0.9, by=other)  # newer
    add_run("fm", 0, 40, 0.1)
    assert collect("smoke").code == ""
    assert cell(collect("smoke"), "1", "ConFlow (D+ and D-)", "none: robot").count == 10
    add_run("cgp", 1, 20, 0.01, by=other)  # there is no other of this seed
    add_run("gaussian", 0, 20, 0.01, by={})
    found = collect("smoke")
    said = "Trained by other code than the present: cgp-s1 (flow/path.py); gaussian-s0 (unknown files)"
    assert found.code == said
    for form in get_args(printing.Format):
        assert said in rendered(found, form) + capsys.readouterr().err
    assert len(list(csv.reader(io.StringIO(rendered(found, "csv"))))[-1]) == len(fields(Cell)), "cells alone"


def test_each_split_is_compared_for_itself_and_named_in_every_title(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    for seed in range(2):
        add_run("cgp", seed, 300, 0.01)
        add_run("fm", seed, 40, 0.01)
    for (split, name), count in zip(config.SPLITS.items(), (600, 602), strict=True):
        found = collect("smoke", split=split)
        assert cell(found, "1", "ConFlow (D+ and D-)", "none: robot").count == count
        text = rendered(found, "markdown")
        titles = [line for line in text.splitlines() if line.startswith("**")]
        assert len(titles) == 5, "three tables, the claims and the reasons"
        assert all(title.endswith(f", {name} split**") for title in titles)
        assert ("Rows without a model are of the test split." in text) == (split == "val")
        rendered(found, "csv")
        assert f"preset smoke, {name} split" in capsys.readouterr().err.splitlines()


def add_described(
    ablation: str, seed: int, *arguments: str, status: str = "FINISHED", count: int = 20, data: str = "a"
) -> None:
    """A run that keeps its settings, and which `data` it learned from, as all do that are trained."""
    run_id = add_run(ablation, seed, count, 0.01, *arguments, status=status)
    store.client().set_tag(run_id, "data_digest", data)
    settings = config.load(["preset=smoke", f"ablation={ablation}", f"seed={seed}", *arguments])
    params = [Param(key, str(value)) for key, value in config.flatten(settings.identity()).items()]
    store.client().log_batch(run_id, params=params)


def test_finished_runs_of_other_tasks_data_and_settings_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The newest first, each once, and neither older runs of what is shown nor those that have not finished."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_task.py").write_text("x = 1\n")
    add_described("cgp", 0)
    add_described("plus", 0, "task=my_task.py")
    add_described("cgp", 1, "task=social", "sample.num=16")
    for _ in range(2):
        add_described("cgp", 0, "data.num=300")
    add_described("cgp", 0)
    add_described("cgp", 2, "data.num=400", status="FAILED")
    found = collect("smoke")
    assert found.others == ["cgp-s0 data.num=300", "social-cgp-s1 sample.num=16", "my_task-plus-s0"]
    said = f"Finished too, of other tasks, data or settings: {', '.join(found.others)}. Compare them by their own ARGS"
    for form in get_args(printing.Format):
        text = rendered(found, form)
        if form == "json":
            assert json.loads(text)["others"] == found.others
        else:  # of CSV beside the cells
            assert said in " ".join((text + capsys.readouterr().err).split())
    assert len(collect("smoke", ["data.num=300"]).runs["cgp"]) == 1
    assert collect("smoke", ["data.num=300"]).others[0] == "cgp-s0", "what was shown before is another now"
    assert collect("smoke", ["task=my_task.py"]).runs.keys() == {"plus"}
    with pytest.raises(
        ConfigError, match=r"data.num=77: no such run has finished in .*; there are cgp-s0, cgp-s0 data"
    ):
        collect("smoke", ["data.num=77"])
    many = replace(found, others=[f"cgp-s{seed}" for seed in range(9)])
    assert "cgp-s5 and 3 more. Compare" in rendered(many, "markdown")
    assert "cgp-s6" not in rendered(many, "markdown")


def test_runs_on_what_a_file_held_before_are_no_part_of_a_row_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the demonstrations that the newest run of this data learned from; other data have other ones."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    of_file = "data.path=mine.npz"
    add_described("cgp", 0, of_file, count=900, data="old")
    add_described("cgp", 1, of_file, count=900, data="old")
    add_described("cgp", 1, of_file, count=10, data="new")
    add_described("no_negatives", 0, of_file, count=30, data="new")
    add_described("cgp", 2, "data.seed=7", data="another generator's seed")
    found = collect("smoke", [of_file])
    assert {ablation: len(ids) for ablation, ids in found.runs.items()} == {"cgp": 1, "no_negatives": 1}
    counts = [one.count for one in found.cells if (one.table, one.column) == ("1", "none: robot")]
    assert counts[:2] == [10, 30]
    assert found.others == ["cgp-s2 data.seed=7", *(f"cgp-s{seed} {of_file} (on other data)" for seed in (1, 0))]
    assert collect("smoke", ["data.seed=7"]).others[-1] == f"cgp-s0 {of_file}"


def test_rows_of_changed_runs_say_what_is_changed_and_are_not_held_against_the_paper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their claims are still about methods; a change of precision alone is none."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    change = "correction.lambda_c=99.0"
    for seed in range(2):
        for ablation, count in (("cgp", 900), ("gaussian", 990)):
            add_described(ablation, seed, change, count=count)
        add_described("cgp", seed, "train.precision=bf16")
    found = collect("smoke", ["correction.lambda_c=99"])
    names = {one.column if one.table == "2" else one.row for one in found.cells}
    assert names >= {f"{name}, {change}" for name in ("ConFlow (D+ and D-)", "no model: source gaussian")}
    assert [name for name in names if not name.endswith(change)] == []
    assert names <= found.commands.keys()
    assert {(one.paper, one.differs) for one in found.cells} == {(None, None)}
    assert found.reasons == {}
    claims = {claim.text: claim for claim in found.claims}
    assert claims["CGP beats Gaussian: collision rate"].verdict == "holds"
    in_bf16 = cell(collect("smoke", ["train.precision=bf16"]), "1", "ConFlow (D+ and D-)", "none: robot")
    assert in_bf16.paper == 0.016


def test_runs_that_were_not_measured_on_a_split_are_left_out_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    add_run("cgp", 0, 20, 0.01, groups=["test/none"])
    with pytest.raises(ConfigError, match=r"no finished run was measured on the validation split.*split=test"):
        collect("smoke")
    assert collect("smoke", split="test").left_out == []
    add_run("cgp", 1, 30, 0.01)
    found = collect("smoke")
    assert cell(found, "1", "ConFlow (D+ and D-)", "none: robot").seeds == 1
    assert "Not measured on the validation split, and left out: cgp-s0; try: split=test" in rendered(found, "table")


def test_records_are_compared_on_test_alone(conflow: Command) -> None:
    result = conflow("compare", "reference=1", "split=val")
    assert (result.returncode, result.stderr.count("\n")) == (2, 1)
    assert "split=val: expected test with reference=1" in result.stderr
