"""What is published of a run, and the tables that are made of it alone."""

import csv
import io
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
from rich.console import Console
from scipy import stats

from conflow.errors import ConfigError
from conflow.results import comparison, paper, printing, records
from conflow.results.records import Record
from conflow.results.statistics import holm
from conflow.results.tables import Cell, tables
from conflow.tracking import code, store
from conflow.training.config import flatten, load
from conflow.training.metrics import wilson


def published(ablation: str, seed: int, count: int, *arguments: str, preset: str = "quick") -> Record:
    """A record in the current folder, with the same count of 1,000 trajectories in every setting."""
    settings = load([f"ablation={ablation}", f"preset={preset}", f"seed={seed}", *arguments])
    metrics: dict[str, float] = {}
    for group in ("test/none", "test/robot", "test/obstacle", "evaluate/sample.solver:rk4/none"):
        metrics |= {f"{group}/num": 1000, f"{group}/robot_collision_count": count, f"{group}/smoothness_median": 0.01}
    flat = {key: str(value) for key, value in flatten(settings.identity()).items()}
    made = Record(f"id-{seed}", ablation, preset, seed, flat, metrics, {"hardware": "a machine"}, 60.0)
    made.write(records.FOLDER)
    return made


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def cell(found: comparison.Comparison, table: str, row: str, column: str) -> Cell:
    (one,) = [c for c in found.cells if (c.table, c.row, c.column) == (table, row, column)]
    return one


def test_a_record_survives_its_file() -> None:
    made = published("cgp", 3, 20, "constraint.reduction=closest")
    (path,) = records.FOLDER.iterdir()
    assert path.name == "cgp-quick-constraint.reduction=closest-s3.json"
    assert Record.read(path) == made


def test_a_record_says_what_was_changed_and_nothing_else() -> None:
    assert published("plus", 0, 1).changes == []
    assert published("cgp", 0, 1, "correction.lambda_c=10", "sample.num=100").changes == [
        "correction.lambda_c=10.0",
        "sample.num=100",
    ]
    # As an argument again; Python's None is no value of a setting.
    assert published("spectral", 0, 1, "source.modes=null").changes == ["source.modes=null"]


def test_a_record_of_many_changes_has_a_name_that_systems_take() -> None:
    """And another one where one of the last changes is another."""
    many = [f"train.{name}={value}" for name, value in (("lr", 0.1), ("max_steps", 7), ("batch_size", 9))]
    many += [f"sample.{name}={value}" for name, value in (("num", 7), ("steps", 9), ("robot_weight", 3))]
    many += ["network.hidden=12", "network.blocks=2", "correction.lambda_c=12", "source.length_scale=0.123"]
    files = [published("cgp", 0, 1, *many, f"data.jitter={jitter}").file for jitter in (0.01, 0.02)]
    assert files[0] != files[1]
    assert max(map(len, files)) < 255
    assert {path.name for path in records.FOLDER.iterdir()} == {*files}


def test_a_row_says_that_its_runs_are_on_different_demonstrations() -> None:
    for seed, digest in ((0, "a" * 64), (1, "b" * 64)):
        made = published("cgp", seed, 10)
        replace(made, origin=made.origin | {"data_digest": digest}).write(records.FOLDER)
    (found,) = comparison.collect_reference()
    row = "cgp (s0: aaaaaaaa; s1: bbbbbbbb)"
    assert found.code == f"Rows of runs on different demonstrations: {row}"


def test_a_record_of_another_task_is_named_by_it(folder: Path) -> None:
    """Of a named one as of one in a file, with what a run keeps of either; the paper's goes without."""
    assert published("cgp", 0, 1).name == "cgp-s0"
    named = published("plus", 3, 20, "task=social", "sample.num=100")
    assert (named.task, named.name, named.changes) == ("social", "social-plus-s3", ["sample.num=100"])
    (folder / "elsewhere").mkdir()
    (folder / "elsewhere" / "my_task.py").write_text("x = 1\n")
    own = published("plus", 3, 20, "task=elsewhere/my_task.py", "train.lr=0.01")
    assert (own.task, own.name, own.changes) == ("my_task", "my_task-plus-s3", ["train.lr=0.01"])
    assert own.name == load(["task=elsewhere/my_task.py", "ablation=plus", "seed=3"]).name
    assert sorted(path.name for path in records.FOLDER.iterdir()) == [
        "cgp-quick-s0.json",
        "my_task-plus-quick-train.lr=0.01-s3.json",
        "social-plus-quick-sample.num=100-s3.json",
    ]


@pytest.mark.parametrize("task", ["social", "my_task.py"])
def test_the_command_of_a_row_names_the_task(task: str, folder: Path) -> None:
    (folder / "my_task.py").write_text("x = 1\n")
    for seed in range(2):
        published("plus", seed, 20, f"task={task}")
    again = f'make ablations ABLATIONS=plus SEEDS="0 1" PRESET=quick TASK={task}'
    commands = set(comparison.collect_reference()[0].commands.values())
    assert again in commands
    # What no model touched is of one run.
    assert all(command.startswith((again, again.replace("0 1", "0"))) for command in commands)


@pytest.mark.parametrize(
    ("task", "run"), [("social", "social-plus-s$s"), ("my_task.py", "my_task-plus-s$s TASK=my_task.py")]
)
def test_the_command_that_samples_a_run_again_brings_the_file_of_its_task(task: str, run: str, folder: Path) -> None:
    """Which no run holds, so that it is asked for; a task with a name a run knows itself."""
    (folder / "my_task.py").write_text("x = 1\n")
    published("plus", 3, 20, f"task={task}")
    (found,) = comparison.collect_reference()
    (again,) = {command for command in found.commands.values() if "evaluate" in command}
    assert again.endswith(f"&& for s in 3; do make evaluate RUN=quick/{run} SPLIT=test ARGS='sample.solver=rk4'; done")


def test_a_task_of_ones_own_has_a_column_for_each_setting_and_constraint(folder: Path) -> None:
    """Those without guidance first; the paper has no numbers for it, and its claims are none of it."""
    (folder / "my_task.py").write_text("x = 1\n")
    for seed in range(2):
        made = published("plus", seed, 0, "task=my_task.py")
        metrics: dict[str, float] = {}
        for setting in ("all", "none"):
            metrics |= {f"test/{setting}/num": 100, f"test/{setting}/speed_collision_count": 7 + seed}
            metrics |= {f"test/{setting}/end_in_box_collision_count": 3, f"test/{setting}/success_count": 90}
        replace(made, metrics=metrics).write(records.FOLDER)
    (found,) = comparison.collect_reference()
    columns = [c.column for c in found.cells if c.table == "1"]
    assert columns == ["none: end_in_box", "none: speed", "all: end_in_box", "all: speed"]
    one = cell(found, "1", "plus: the best together, task=my_task.py", "all: speed")
    assert (one.count, one.trajectories, one.paper, one.differs) == (15, 200, None, None)
    assert (found.claims, found.reasons) == ([], {})
    assert {c.table for c in found.cells} == {"1", "3"}


def test_a_crowd_has_a_column_for_what_descent_refined_too(folder: Path) -> None:
    for seed in range(2):
        made = published("plus", seed, 0, "task=weave")
        assert made.changes == []
        metrics: dict[str, float] = {}
        for setting in ("none", "robot", "refined"):
            metrics |= {f"test/{setting}/num": 100, f"test/{setting}/robot_collision_count": 7 + seed}
        replace(made, metrics=metrics).write(records.FOLDER)
    (found,) = comparison.collect_reference()
    assert [c.column for c in found.cells if c.table == "1"] == ["none: robot", "refined: robot", "robot: robot"]
    assert found.claims == []


def test_what_a_task_was_made_with_is_a_change_and_in_the_command(folder: Path) -> None:
    made = published("plus", 0, 0, "task=weave", "task.robots=[10, 20]")
    assert made.changes == ["task.robots=[10, 20]"]
    (found,) = comparison.collect_reference()
    assert any("TASK=weave ARGS='task.robots=[10,20]'" in command for command in found.commands.values())


def test_records_of_several_tasks_are_compared_apart(folder: Path) -> None:
    """Of one ablation at one preset, changed or not: the paper's task first, the rows of others named by theirs."""
    (folder / "my_task.py").write_text("x = 1\n")
    for task, count in (("social", 20), ("my_task.py", 30), ("swap", 40)):
        for ablation in ("cgp", "plus"):
            published(ablation, 0, count, f"task={task}")
        published("cgp", 0, count + 1, f"task={task}", "train.batch_size=512")
    published("cgp", 0, 50, preset="long")
    found = comparison.collect_reference()
    places = [(one.preset, one.task) for one in found]
    assert places == [("long", "swap"), ("quick", "swap"), ("quick", "my_task.py"), ("quick", "social")]
    change = "ConFlow (D+ and D-), train.batch_size=512"
    for one, count, of_task in zip(found[1:], (40, 30, 20), ("", ", task=my_task.py", ", task=social"), strict=True):
        row = cell(one, "1", f"plus: the best together{of_task}", "none: robot")
        assert (row.count, row.seeds, row.paper is None) == (count, 1, True)
        assert cell(one, "4", f"{change}{of_task}", "none: robot").count == count + 1
        shown = {each.column if each.table == "2" else each.row for each in one.cells}
        assert shown <= one.commands.keys()
        assert all(name.endswith(of_task) for name in (*shown, *one.commands))
        assert all((f"TASK={one.task}" in again) == (one.task != "swap") for again in one.commands.values())


@pytest.mark.parametrize("task", ["passing", "social"])
def test_the_papers_numbers_stand_beside_its_own_task_alone(task: str) -> None:
    for of_task in (task, "swap"):
        for ablation in ("cgp", "gaussian"):
            published(ablation, 0, 20, f"task={of_task}")
    swap, other = comparison.collect_reference()
    assert {one.table for one in other.cells} >= {"1", "2"}
    assert {one.table for one in swap.cells if one.paper is not None} == {"1", "2"}
    assert [one for one in other.cells if one.paper is not None] == []


def test_every_format_says_of_which_task_a_number_is() -> None:
    """And the overview is of the paper's alone: no column of it is another task's."""
    for preset in ("long", "quick"):
        published("plus", 0, 20, "task=social", preset=preset)
    published("plus", 0, 40)
    found = comparison.collect_reference()
    text = {}
    for form in get_args(printing.Format):
        console = Console(width=400)
        with console.capture() as captured:
            printing.render(found, form, console)
        text[form] = captured.get()
    tree = json.loads(text["json"])
    assert list(tree["presets"]) == ["quick", "long, task=social", "quick, task=social"]
    rows = [(one["preset"], one["row"]) for one in tree["cells"]]
    assert rows == [(line["preset"], line["row"]) for line in csv.DictReader(io.StringIO(text["csv"]))]
    counts = {one["count"] for one in tree["cells"] if one["row"] == "plus: the best together, task=social"}
    assert {20} <= counts <= {20, None}
    titles = [line for line in text["markdown"].splitlines() if line.startswith("**Table 1")]
    assert [title.partition("is hit), ")[2] for title in titles] == [
        "preset quick, test split**",
        "task social, preset long, test split**",
        "task social, preset quick, test split**",
    ]
    assert "at each preset" not in text["markdown"], "of the paper's task there is one preset"
    published("plus", 0, 50, preset="long")
    with console.capture() as captured:
        printing.render(comparison.collect_reference(), "markdown", console)
    overview = captured.get().partition("at each preset, ")[2].splitlines()
    assert overview[2] == "|  | printed in the paper | preset long | preset quick |"
    assert [line.split(" | ")[0] for line in overview[4:] if line.startswith("| ")] == ["| plus: the best together"]


def test_the_overview_shows_the_papers_methods_and_the_best_alone() -> None:
    for preset in ("quick", "long"):
        for ablation in ("cgp", "spectral", "plus"):
            published(ablation, 0, 20, preset=preset)
    console = Console(width=400)
    with console.capture() as captured:
        printing.render(comparison.collect_reference(), "markdown", console)
    text = captured.get()
    overview = text[text.index("**Robot collisions without guidance, at each preset, test split**") :].splitlines()
    rows = [line.split(" | ")[0].removeprefix("| ") for line in overview[4:] if line.startswith("| ")]
    assert rows == ["ConFlow (D+ and D-)", "plus: the best together"]
    assert "| spectral network" in text, "in the tables of its preset it is"


def test_a_setting_that_came_later_counts_as_its_default() -> None:
    made = published("cgp", 0, 1)
    path = next(records.FOLDER.iterdir())
    content = json.loads(path.read_text())
    del content["settings"]["correction.edges"]
    path.write_text(json.dumps(content))
    assert Record.read(path).changes == made.changes == []


def test_tables_of_record_pool_seeds_and_keep_other_readings_apart() -> None:
    for seed in range(3):
        published("cgp", seed, 300 + seed)
        published("cgp", seed, 200 + seed, "constraint.reduction=closest")
    (found,) = comparison.collect_reference()
    plain = cell(found, "1", "ConFlow (D+ and D-)", "none: robot")
    assert (plain.count, plain.trajectories, plain.seeds, plain.preset) == (903, 3000, 3, "quick")
    reading = "ConFlow (D+ and D-), constraint.reduction=closest"
    assert cell(found, "4", reading, "none: robot").count == 603
    assert cell(found, "4", "default", "none: robot").count == 903
    assert cell(found, "4", "ConFlow (D+ and D-), sample.solver:rk4", "none: robot").count == 903
    assert found.commands[reading] == (
        "make ablations ABLATIONS=cgp SEEDS=\"0 1 2\" PRESET=quick ARGS='constraint.reduction=closest'"
    )


def test_what_a_published_run_lacks_of_the_settings_has_its_default_in_later() -> None:
    """Else a model of an earlier version could not be loaded any more, and would be of another experiment."""
    expected = flatten(load().identity()).keys()
    published = list((Path(__file__).parents[1] / "runs/reference/runs").glob("planar_arms-*.json"))
    assert published
    for path in published:
        assert expected <= Record(**json.loads(path.read_text())).settings.keys(), path.name


def test_a_run_in_bf16_counts_for_a_seed_that_has_none_in_single_precision() -> None:
    """The row says which seed is of which precision and machine, and how both are made again."""
    published("cgp", 0, 300)
    published("cgp", 0, 100, "train.precision=bf16")
    published("cgp", 1, 200, "train.precision=bf16")
    (found,) = comparison.collect_reference()
    plain = cell(found, "1", "ConFlow (D+ and D-)", "none: robot")
    assert (plain.count, plain.seeds) == (500, 2)
    assert plain.machine == "s0: 32 bits on a machine; s1: bf16 on a machine"
    assert found.commands["ConFlow (D+ and D-)"] == (
        'make ablations ABLATIONS=cgp SEEDS="0" PRESET=quick && '
        "make ablations ABLATIONS=cgp SEEDS=\"1\" PRESET=quick ARGS='train.precision=bf16'"
    )
    # Seed 0 in both stands beside each other.
    beside = cell(found, "4", "ConFlow (D+ and D-), train.precision=bf16", "none: robot")
    assert (beside.count, beside.seeds, beside.machine) == (100, 1, "bf16 on a machine")


def test_a_reading_in_bf16_counts_for_a_seed_that_has_none_in_single_precision() -> None:
    """As one of no changes does, under the reading's own name."""
    published("cgp", 0, 300, "correction.mask=feasible")
    published("cgp", 0, 100, "correction.mask=feasible", "train.precision=bf16")
    published("cgp", 1, 200, "correction.mask=feasible", "train.precision=bf16")
    published("cgp", 0, 50, "data.seed=7", "train.precision=bf16")
    (found,) = comparison.collect_reference()
    row = "ConFlow (D+ and D-), correction.mask=feasible"
    assert [cell(found, "4", row, "none: robot").count, cell(found, "4", row, "none: robot").seeds] == [500, 2]
    assert cell(found, "4", f"{row} train.precision=bf16", "none: robot").count == 100
    assert cell(found, "5", "ConFlow (D+ and D-), data.seed=7", "none: robot").machine == "bf16 on a machine"


def test_that_negatives_help_is_claimed_for_each_reading_that_has_both() -> None:
    """All claims together are corrected once; what is no reading of the paper is not judged."""
    for seed in range(3):
        for ablation, count in (("cgp", 10), ("no_negatives", 400)):
            published(ablation, seed, count + seed)
            published(ablation, seed, 410 - count + seed, "constraint.reduction=closest", "train.precision=bf16")
            published(ablation, seed, count + seed, "train.lr=0.1")
        published("cgp", seed, count + seed, "correction.mask=feasible")
    (found,) = comparison.collect_reference()
    claims = {claim.text: claim for claim in found.claims if claim.text.startswith("negatives help ConFlow (")}
    assert len(claims) == 8
    assert claims["negatives help ConFlow (none: robot)"].verdict == "holds"
    reading = claims["negatives help ConFlow (none: robot), constraint.reduction=closest"]
    assert (reading.verdict, reading.detail) == ("reversed", "0.4010 against 0.0110, 3 and 3 seeds, 3 in pairs")
    tested = [claim for claim in found.claims if claim.p is not None and claim.corrected_p is not None]
    assert [claim.corrected_p for claim in tested] == holm([claim.p for claim in tested if claim.p is not None])


def test_readings_of_another_task_show_its_own_collisions() -> None:
    """Of arms, which have no robots' discs that could collide."""
    path = Path(__file__).parents[1] / "runs/reference/runs/pandas-no_negatives-quick-sample.steps=25-s0.json"
    shown = {cell.column: cell.count for cell in tables({}, {"a reading": [Record.read(path)]})}
    assert shown["none: arms"] == Record.read(path).metrics["test/none/arms_collision_count"]
    assert shown["all: speed"] == Record.read(path).metrics["test/all/speed_collision_count"]
    settings = [column.removesuffix(": success") for column in shown if column.endswith(": success")]
    assert settings[0] == "none"
    assert {*settings} == {column.split(": ")[0] for column in shown if ": arms" in column}
    assert shown["all: success"] == Record.read(path).metrics["test/all/success_count"]
    assert "smoothness, median" in shown
    assert "none: robot" not in shown


def test_the_command_of_a_row_stands_beside_it() -> None:
    """Of every row of every table, and of Table 2's columns; where it was sampled again, that too."""
    for seed in range(2):
        published("cgp", seed, 300)
        published("gaussian", seed, 300)
        published("cgp", seed, 300, "data.amplitudes=[0.9,0.15]", "data.jitter=0.05")
    (found,) = comparison.collect_reference()
    assert {cell.row for cell in found.cells if cell.table != "2"} <= set(found.commands)
    assert {cell.column for cell in found.cells if cell.table == "2"} <= set(found.commands)
    train = 'make ablations ABLATIONS=cgp SEEDS="0 1" PRESET=quick'
    assert found.commands["default"] == train
    assert found.commands["ConFlow (D+ and D-), sample.solver:rk4"] == (
        f"{train} && for s in 0 1; do make evaluate RUN=quick/cgp-s$s SPLIT=test ARGS='sample.solver=rk4'; done"
    )
    other, again = (command for command in found.commands.values() if "amplitudes" in command)
    assert other == f"{train} ARGS='data.amplitudes=[0.9,0.15] data.jitter=0.05'"
    assert again.startswith(f"{other} && for s in 0 1; do make evaluate")
    console = Console(width=400)
    with console.capture() as captured:
        printing.render([found], "markdown", console)
    lines = captured.get().splitlines()
    assert any(line.startswith("| default") and line.endswith(f"| `{train}` |") for line in lines)
    assert f"| again with | `{train.replace('cgp', 'gaussian')}` | `{train}` |" in lines


def test_a_narrow_terminal_cuts_no_command_short() -> None:
    published("no_negatives", 0, 300)
    console = Console(width=80)
    with console.capture() as captured:
        printing.render(comparison.collect_reference(), "table", console)
    beside = "".join(line.rsplit("│", 2)[1].strip() for line in captured.get().splitlines() if line.endswith("│"))
    assert "ABLATIONS=no_negatives" in beside


def test_every_preset_is_compared_for_itself_the_one_of_most_training_first() -> None:
    """A claim never sets a long training against a short one; a change alone is still a row at its preset."""
    published("cgp", 0, 300)
    published("cgp", 0, 290, "train.batch_size=512")
    published("cgp", 0, 16, preset="long")
    published("fm", 0, 31)
    published("cgp", 0, 280, "train.batch_size=512", preset="paper")
    long, quick, paper = comparison.collect_reference()
    assert (long.preset, quick.preset, paper.preset) == ("long", "quick", "paper")
    change = "ConFlow (D+ and D-), train.batch_size=512"
    assert [cell(found, "4", change, "none: robot").count for found in (paper, quick)] == [280, 290]
    assert [cell(found, "1", "ConFlow (D+ and D-)", "none: robot").count for found in (long, quick)] == [16, 300]
    verdicts = [next(iter(found.claims)).verdict for found in (long, quick)]
    assert verdicts == ["no runs", "too few seeds"]
    assert (paper.claims, {each.table for each in paper.cells}) == ([], {"4"})
    assert "PRESET=paper ARGS='train.batch_size=512'" in paper.commands[change]
    console = Console(width=400)
    with console.capture() as captured:
        printing.render([long, quick, paper], "markdown", console)
    text = captured.get()
    low, high = wilson(300, 1000)
    overview = text[text.index("**Robot collisions without guidance, at each preset, test split**") :].splitlines()
    assert overview[2] == "|  | printed in the paper | preset long | preset quick |"
    assert overview[4].startswith("| ConFlow (D+ and D-) | 0.016 | 0.0160, within this network [")
    beside = f"0.3000, within this network [{low:.4f}, {high:.4f}]<br>300 of 1000, 1 seed"
    assert overview[4].endswith(f"16 of 1000, 1 seed | {beside} |")
    assert overview[5].startswith("| FM (D+) | 0.031 |  | 0.0310, within this network [")
    with console.capture() as captured:
        printing.render([long, quick, paper], "json", console)
    tree = json.loads(captured.get())
    assert [each["preset"] for each in tree["cells"]] == [c.preset for one in (long, quick, paper) for c in one.cells]
    assert tree["presets"]["quick"]["claims"][0]["verdict"] == "too few seeds"
    titles = [line.strip("*") for line in text.splitlines() if line.startswith("**Table")]
    assert all(title.endswith(", test split") for title in titles)
    assert [title[6] + title.removesuffix(", test split").rsplit(" ", 1)[1] for title in titles] == [
        *("1long", "2long", "3long", "4long", "1quick", "2quick", "3quick", "4quick", "4paper")
    ]


def test_reasons_are_of_the_columns_that_differ() -> None:
    """In the unguided column alone, in guided ones alone, and in both; above the paper's number, or below it."""
    for seed in range(2):
        published("cgp", seed, 300 + seed)
        published("no_negatives", seed, 40 + seed)  # as the paper's 0.043 unguided
        published("fm_mixed", seed, 270 + seed)  # guided as the paper's 0.27
        published("fm", 0, 300)  # of one seed nothing is said
    for seed in range(5):  # below, of which something is known for ConFlow (D+) alone
        published("no_negatives", seed, 0, preset="long")
        published("fm_mixed", seed, 0, preset="long")
    long, quick = comparison.collect_reference()
    assert quick.reasons == {
        "ConFlow (D+ and D-)": f"{paper.ABOVE['cgp']}; {paper.GUIDED}",
        "FM (D+ and D-)": paper.ABOVE["fm_mixed"],
    }
    assert long.reasons == {"ConFlow (D+)": paper.BELOW["no_negatives"]}


def test_a_rate_is_compared_with_the_papers_as_one_more_network_of_256() -> None:
    for seed in range(2):
        published("cgp", seed, 300 + seed)
        published("no_negatives", seed, 40)
    published("fm", 0, 300)
    (found,) = comparison.collect_reference()
    verdicts = {
        row: cell(found, "1", row, "none: robot").differs for row in ("ConFlow (D+ and D-)", "ConFlow (D+)", "FM (D+)")
    }
    assert verdicts == {"ConFlow (D+ and D-)": True, "ConFlow (D+)": False, "FM (D+)": None}
    console = Console()
    with console.capture() as captured:
        printing.render([found], "markdown", console)
    for shown in ("paper 0.043, not distinguishable", "paper 0.016, differs", "paper 0.031, one seed: not judged"):
        assert shown in captured.get()


def test_a_mean_over_seeds_has_students_interval_and_its_networks_that_of_independent_errors() -> None:
    """Within k networks with errors e_i: sqrt(sum e_i^2) / k below and above, each side for itself."""
    for seed, (low, value, high) in enumerate(((0.007, 0.010, 0.014), (0.008, 0.012, 0.015))):
        made = published("cgp", seed, 300)
        names = ("test/none/smoothness_median", "test/none/energy_distance")
        ends = {f"{name}{end}": one for name in names for end, one in (("_low", low), ("", value), ("_high", high))}
        replace(made, metrics=made.metrics | ends).write(records.FOLDER)
    (found,) = comparison.collect_reference()
    one = cell(found, "3", "ConFlow (D+ and D-)", "smoothness, median")
    assert (one.within_low, one.within_high) == pytest.approx((0.011 - 0.005 / 2, 0.011 + 0.005 / 2))
    half = float(stats.t.isf(0.025, 1)) * 0.001
    assert (one.low, one.high) == pytest.approx((0.011 - half, 0.011 + half))
    # All distances are to one reference, so their errors are no smaller in the mean.
    shared = cell(found, "3", "ConFlow (D+ and D-)", "energy distance to held-out D+")
    assert (shared.within_low, shared.within_high) == pytest.approx((0.011 - 0.0035, 0.011 + 0.0035))
    reach = math.hypot(half, 0.0035)
    assert (shared.low, shared.high) == pytest.approx((0.011 - reach, 0.011 + reach))
    # Where a seed has none, neither have its networks together.
    published("cgp", 1, 300)
    (found,) = comparison.collect_reference()
    assert cell(found, "3", "ConFlow (D+ and D-)", "smoothness, median").within_low is None


def test_a_row_of_several_codes_says_so_and_one_of_none_does_not() -> None:
    made = [published("cgp", seed, 300) for seed in range(3)]
    changed = published("cgp", 0, 300, "train.batch_size=512")
    assert [found.code for found in comparison.collect_reference()] == [""]
    for one, sha in zip((*made[1:], changed), ("a" * 16, "a" * 16, "b" * 16), strict=True):
        replace(one, origin={"code_sha": sha}).write(records.FOLDER)
    (found,) = comparison.collect_reference()
    assert found.code == f"Rows of runs by different code: cgp (s0: unknown; s1, s2: {'a' * 16})"
    console = Console(width=200)
    with console.capture() as captured:
        printing.render([found], "markdown", console)
    assert found.code in captured.get().splitlines()
    replace(made[0], origin={"code_sha": "a" * 16}).write(records.FOLDER)
    assert [found.code for found in comparison.collect_reference()] == [""]


def test_no_records_and_broken_ones_are_named() -> None:
    with pytest.raises(ConfigError, match="expected records in"):
        comparison.collect_reference()
    published("cgp", 0, 1)
    (records.FOLDER / "broken.json").write_text("{")
    with pytest.raises(ConfigError, match=r"broken\.json: expected the record of a run"):
        comparison.collect_reference()


def test_what_is_published_is_what_the_store_has(folder: Path) -> None:
    client = store.client()
    experiment = client.get_experiment_by_name("conflow")
    assert experiment is not None
    settings = load(["preset=smoke"])
    tags = {"ablation": "cgp", "preset": "smoke", "seed": "0", "config_sha": settings.sha(), "git_sha": "abc"}
    tags |= code.tags()
    run_id = client.create_run(experiment.experiment_id, tags=tags).info.run_id
    for key, value in flatten(settings.tree()).items():
        client.log_param(run_id, key, str(value))
    client.log_metric(run_id, "test/none/num", 10)
    client.log_metric(run_id, "validation/none/num", 10)
    client.log_metric(run_id, "test/obstacle/success_rate", 0.5)
    client.log_metric(run_id, "val/none/robot_collision_rate", 0.2)
    client.log_metric(run_id, "train/loss", 0.1)
    client.set_terminated(run_id, "FINISHED")
    (path,) = records.publish("smoke")
    made = Record.read(path)
    expected = {"test/none/num": 10, "validation/none/num": 10, "test/obstacle/success_rate": 0.5}
    assert (made.run_id, made.metrics) == (run_id, expected)
    assert made.origin == {**code.tags(), "git_sha": "abc"}
    assert made.changes == []


def finished_run(count: int, *arguments: str, ablation: str = "cgp") -> None:
    """A finished run in the store, of these settings but for an ablation whose file is none here."""
    client = store.client()
    experiment = client.get_experiment_by_name("conflow")
    assert experiment is not None
    settings = load(["preset=smoke", *arguments])
    tags = {"ablation": ablation, "preset": "smoke", "seed": "0", "config_sha": settings.sha()} | code.tags()
    run_id = client.create_run(experiment.experiment_id, tags=tags).info.run_id
    for key, value in flatten(settings.identity()).items():
        client.log_param(run_id, key, str(value))
    client.log_metric(run_id, "test/none/num", count)
    client.set_terminated(run_id, "FINISHED")


def test_the_newest_run_of_a_name_is_published_though_its_task_was_edited(folder: Path) -> None:
    """Whose code is in the fingerprint of the config and in no file's name."""
    for count, text in ((10, "x = 1\n"), (20, "x = 2\n")):
        (folder / "my_task.py").write_text(text)
        finished_run(count, "task=my_task.py")
    (path,) = records.publish("smoke")
    assert Record.read(path).metrics == {"test/none/num": 20}


def test_a_run_of_an_ablation_that_is_gone_keeps_no_other_from_being_published(folder: Path) -> None:
    finished_run(10)
    finished_run(20, "train.max_steps=7", ablation="mine")
    assert [path.name for path in records.publish("smoke")] == ["cgp-smoke-s0.json"]


def test_what_a_run_from_before_called_success_is_not_mixed_with_what_it_is_now(folder: Path) -> None:
    """Before runs were measured on the validation split, success ignored the obstacle."""
    client = store.client()
    experiment = client.get_experiment_by_name("conflow")
    assert experiment is not None
    tags = {"ablation": "cgp", "preset": "smoke", "seed": "0", "config_sha": load(["preset=smoke"]).sha()}
    for validated in (False, True):
        run_id = client.create_run(experiment.experiment_id, tags=tags).info.run_id
        client.log_metric(run_id, "test/none/success_low", 0.5)
        if validated:
            client.log_metric(run_id, "validation/none/num", 10)
        client.set_terminated(run_id, "FINISHED")
        metrics = Record.of(client.get_run(run_id)).metrics
        assert ("test/none/success_low" in metrics) == validated
        assert metrics.get("test/none/success_at_waypoints_low") == (None if validated else 0.5)


def test_the_results_of_a_split_are_found_where_the_tables_look_for_them() -> None:
    metrics = {
        "test/none/num": 1.0,
        "evaluate/seed:8/none/num": 2.0,
        "without_model/data/num": 3.0,
        "validation/none/num": 4.0,
        "evaluate/val seed:8/none/num": 5.0,
        "evaluate/val same settings/none/num": 6.0,
    }
    made = replace(published("cgp", 0, 1), metrics=metrics)
    assert made.on("test").metrics == dict(list(metrics.items())[:3])
    assert made.on("val").metrics == {
        "without_model/data/num": 3.0,
        "test/none/num": 4.0,
        "evaluate/seed:8/none/num": 5.0,
        "evaluate/same settings/none/num": 6.0,
    }


def test_a_method_on_other_demonstrations_has_a_table_of_its_own_with_their_d_plus() -> None:
    """What alone is changed is what it learned from, so it is no reading of the paper."""
    for seed in range(2):
        published("plus", seed, 5)
        made = published("plus", seed, 7 + seed, "data.seed=101")
        feasible = {"without_model/feasible/num": 400, "without_model/feasible/near_count": 100}
        replace(made, metrics=made.metrics | feasible | {"test/none/near_count": 200}).write(records.FOLDER)
    published("cgp", 0, 30, "constraint.reduction=closest")
    (found,) = comparison.collect_reference()
    row = "plus: the best together, data.seed=101"
    assert cell(found, "5", row, "none: robot").count == 15
    assert (cell(found, "5", row, "near rate").count, cell(found, "5", row, "near rate").trajectories) == (400, 2000)
    shown = cell(found, "5", "no model: feasible, data.seed=101", "near rate")
    assert (shown.count, shown.trajectories) == (100, 400), "once, though both seeds have it"
    assert {one.row for one in found.cells if one.table == "4"} & {row} == set()
    assert found.commands[row] == "make ablations ABLATIONS=plus SEEDS=\"0 1\" PRESET=quick ARGS='data.seed=101'"


@pytest.mark.parametrize("change", ["data.negative_share=0.5", "data.val_fraction=0.2", "data.negatives=false"])
def test_what_is_learned_of_the_same_demonstrations_is_a_reading(change: str) -> None:
    published("cgp", 0, 30, change)
    published("cgp", 0, 40, change, "data.seed=7")
    published("cgp", 0, 50, "data.num=500", "data.seed=7")
    (found,) = comparison.collect_reference()
    rows = {table: {one.row for one in found.cells if one.table == table} for table in "45"}
    assert [len(rows["4"]), len(rows["5"])] == [4, 2], "each as trained and as sampled again"
    assert all("data.num" in row for row in rows["5"])


def test_what_no_model_touched_of_other_demonstrations_is_there_once() -> None:
    """However many methods learned from them, and of one that measured it."""
    for ablation in ("cgp", "plus", "descent"):
        made = published(ablation, 0, 5, "data.seed=101")
        if ablation != "cgp":
            feasible = {"without_model/feasible/num": 400, "without_model/feasible/near_count": 100}
            replace(made, metrics=made.metrics | feasible).write(records.FOLDER)
    (found,) = comparison.collect_reference()
    assert cell(found, "5", "no model: feasible, data.seed=101", "near rate").trajectories == 400
    keys = [(one.table, one.row, one.column) for one in found.cells]
    assert len(keys) == len(set(keys))


def test_a_row_that_was_sampled_again_is_of_the_seeds_that_were() -> None:
    """One of two networks sampled with other settings is a row of one seed, and not none."""
    published("plus", 0, 5)
    made = published("plus", 1, 5)
    plain = {key: value for key, value in made.metrics.items() if not key.startswith("evaluate/")}
    replace(made, metrics=plain).write(records.FOLDER)
    (found,) = comparison.collect_reference()
    row = "plus: the best together, sample.solver:rk4"
    assert (cell(found, "4", row, "none: robot").seeds, cell(found, "4", row, "none: robot").count) == (1, 5)
    assert "for s in 0; do make evaluate" in found.commands[row]


def test_a_changed_run_that_was_sampled_again_has_a_row_for_each() -> None:
    """In the table of what is changed, each beside the command that trains it so and then samples it so."""
    for seed in range(2):
        published("cgp", seed, 30, "constraint.reduction=closest")
        published("plus", seed, 5, "data.seed=101")
    (found,) = comparison.collect_reference()
    for table, row, count in (
        ("4", "ConFlow (D+ and D-), constraint.reduction=closest", 60),
        ("5", "plus: the best together, data.seed=101", 10),
    ):
        again = f"{row}, sample.solver:rk4"
        assert [cell(found, table, name, "none: robot").count for name in (row, again)] == [count, count]
        assert found.commands[again].startswith(f"{found.commands[row]} && for s in 0 1; do make evaluate RUN=quick/")
        assert found.commands[again].endswith("-s$s SPLIT=test ARGS='sample.solver=rk4'; done")
