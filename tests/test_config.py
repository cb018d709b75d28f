import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from conflow.errors import ConfigError
from conflow.scene.tasks import SWAPS, TASKS
from conflow.training import config
from conflow.training.config import CONF, OF_SWAPS, SIZES
from tests.test_layout import loaded

# What each ablation may change of the defaults; "changing only what its name says".
CHANGES = {
    "cgp": set(),
    "gaussian": {"source.kind"},
    "gp": {"source.kind"},
    "no_negatives": {"data.negatives"},
    "fm": {"source.kind", "correction.lambda_c", "data.negatives"},
    "fm_mixed": {"source.kind", "correction.lambda_c"},
    "covariant": {"correction.smoothing", "correction.lambda_c"},
    "guided_path": {"correction.smoothing", "correction.lambda_c", "correction.path"},
    "repair": {"data.repair", "correction.margin"},
    "spectral": {"network.kind", "source.modes"},
    "fitted": {"source.fit"},
    "end": {
        "correction.at",
        "correction.smoothing",
        "correction.lambda_c",
        "correction.margin",
        "data.negative_share",
        "sample.guidance",
    },
    "few_steps": {"sample.solver", "sample.steps"},
}
CHANGES["descent"] = {
    *("data.negatives", "source.fit", "constraint.gamma", "network.kind", "train.norm", "train.max_steps"),
    *("correction.lambda_c", "correction.smoothing", "correction.margin", "correction.walls"),
    *("sample.num", "sample.steps", "sample.guidance", "sample.robot_weight", "sample.obstacle_weight"),
}
CHANGES["plus"] = (CHANGES["end"] | CHANGES["spectral"] | CHANGES["fitted"]) - {"source.modes"} | {
    "constraint.gamma",
    "correction.ramp",
    "correction.walls",
    "train.norm",
    "sample.steps",
    "train.max_steps",
    "sample.num",
    "sample.robot_weight",
    "sample.obstacle_weight",
}


def changes(*arguments: str) -> set[str]:
    base, other = (config.flatten(config.load(list(a)).tree()) for a in ((), arguments))
    return {key for key in base if base[key] != other[key]}


def test_every_ablation_is_listed_here() -> None:
    assert set(CHANGES) == set(config.names("ablation"))


@pytest.mark.parametrize("ablation", CHANGES)
def test_an_ablation_changes_only_what_its_name_says(ablation: str) -> None:
    assert changes(f"ablation={ablation}") - {"ablation"} == CHANGES[ablation]


def written(axis: str, name: str) -> set[str]:
    """The settings that a file of conf/ sets, also those that it sets to the default."""
    tree = yaml.safe_load((CONF / axis / f"{name}.yaml").read_text())
    tree.pop("times", None)
    return set(config.flatten(tree))


# The solver's steps belong to both: a method may do with few, and smoke tests must.
SHARED = {"sample.steps"}
OF_PRESETS = set(SIZES) | {"train.lr", "train.schedule"}


@pytest.mark.parametrize("preset", config.names("preset"))
def test_a_preset_says_how_much_compute_and_nothing_about_the_method(preset: str) -> None:
    assert written("preset", preset) <= OF_PRESETS | SHARED


@pytest.mark.parametrize("ablation", config.names("ablation"))
def test_an_ablation_says_nothing_about_how_much_compute(ablation: str) -> None:
    """What presets set it may multiply, so that every preset stays what its name says."""
    assert not written("ablation", ablation) & OF_PRESETS
    with_it, without = (config.load(["preset=smoke", f"ablation={name}"]) for name in (ablation, "cgp"))
    assert with_it.train.max_steps <= without.train.max_steps
    assert with_it.train.batch_size * with_it.network.hidden <= without.train.batch_size * without.network.hidden
    assert with_it.sample.num <= 5 * without.sample.num


@pytest.fixture
def ablation_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of an ablation `mine`, to be written, beside all others."""
    monkeypatch.setattr(config, "CONF", shutil.copytree(CONF, tmp_path / "conf"))
    return tmp_path / "conf" / "ablation" / "mine.yaml"


def test_times_multiplies_what_the_preset_says_and_arguments_are_absolute(ablation_file: Path) -> None:
    ablation_file.write_text("times: {train.max_steps: 0.4, sample.num: 5}")
    for preset, steps, num in (("paper", 8000, 10240), ("quick", 1600, 10240), ("smoke", 16, 320)):
        settings = config.load(["ablation=mine", f"preset={preset}"])
        assert (settings.train.max_steps, settings.sample.num) == (steps, num)
    settings = config.load(["ablation=mine", "train.max_steps=7"])
    assert (settings.train.max_steps, settings.sample.num) == (7, 10240)
    # What leaves is plain numbers: the same config, however it was asked for.
    assert settings == config.load(["ablation=mine", "sample.num=10240", "train.max_steps=7"])
    assert config.from_tree(settings.tree()) == settings


def test_times_leaves_at_least_the_smallest_number_that_a_setting_takes(ablation_file: Path) -> None:
    ablation_file.write_text("times: {train: {max_steps: 1.0e-9}, sample: {num: 1.0e-9}, data: {num: 1.0e-9}}")
    settings = config.load(["ablation=mine"])
    assert (settings.train.max_steps, settings.sample.num, settings.data.num) == (1, 2, 10)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ("{train.max_stepz: 2}", "train.max_stepz=2: expected one of data.num, "),
        ("{train.max_stepz: 2}", "did you mean train.max_steps?"),
        ("{correction.lambda_c: 2}", "correction.lambda_c=2: expected one of data.num, "),
        ("{3: 2}", "3=2: expected one of data.num, "),
        *((f"{{sample.num: {factor}}}", "expected a number above 0 and at most") for factor in (0, -1, ".nan", ".inf")),
        *(
            (f"{{sample.num: {factor}}}", "expected a number above 0 and at most")
            for factor in ("much", "true", "null")
        ),
        (f"{{sample.num: {10**400}}}", "expected a number above 0 and at most"),
        ("{sample.num: 1.0e+9}", "expected a whole number of at least 2 and at most 1000000000"),
        ("3", "expected settings and what to multiply them by, found 3"),
    ],
)
def test_a_bad_factor_is_refused_in_one_line_that_names_the_file(times: str, said: str, ablation_file: Path) -> None:
    ablation_file.write_text(f"times: {times}")
    with pytest.raises(ConfigError) as refused:
        config.load(["ablation=mine"])
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith("conf/ablation/mine.yaml: times" if "1.0e+9" not in times else "sample.num=")


def test_only_an_ablation_multiplies(ablation_file: Path) -> None:
    (ablation_file.parents[1] / "preset" / "mine.yaml").write_text("times: {sample.num: 2}")
    with pytest.raises(ConfigError, match=r"times\.sample\.num: no such setting"):
        config.load(["preset=mine"])
    with pytest.raises(ConfigError, match=r"times\.sample\.num: no such setting"):
        config.load(["times.sample.num=2"])


def test_preset_paper_is_the_appendix() -> None:
    paper = config.load(["preset=paper"])
    assert (paper.network.hidden, paper.network.blocks) == (1024, 4)
    assert (paper.train.lr, paper.train.batch_size, paper.train.max_steps, paper.train.clip) == (3e-4, 2048, 20001, 3.0)
    assert (paper.source.length_scale, paper.source.sigma_f, paper.source.epsilon) == (0.4, 1.0, 1e-6)
    assert (paper.correction.lambda_c, paper.correction.sigma, paper.correction.width) == (2.5, 5.0, 9)
    assert (paper.constraint.radius, paper.constraint.gamma) == (0.3, 10.0)
    assert (1 / paper.sample.steps, paper.sample.robot_weight, paper.sample.obstacle_weight) == (0.004, 0.08, 1.0)
    assert (paper.data.num, paper.data.horizon, paper.train.schedule) == (10000, 32, "constant")


def test_base_yaml_sets_every_setting() -> None:
    base = yaml.safe_load((CONF / "base.yaml").read_text())
    assert set(config.flatten(base)) == set(config.flatten(config.load().tree()))


def test_arguments_win_over_ablation_and_ablation_over_preset_and_the_last_argument_wins() -> None:
    assert config.load(["ablation=fm"]).correction.lambda_c == 0
    settings = config.load(["correction.lambda_c=1", "ablation=fm", "correction.lambda_c=7", "preset=smoke"])
    assert settings.correction.lambda_c == 7
    assert settings.train.max_steps == 40


def test_values_mean_what_the_settings_type_says() -> None:
    settings = config.load(["data.path=1e3", "train.lr=1e-3", "data.negatives=false", "data.amplitudes=[0.2, 0.1, 0]"])
    assert settings.data.path == "1e3"
    assert settings.train.lr == 1e-3
    assert settings.data.negatives is False
    assert settings.data.amplitudes == [0.2, 0.1, 0.0]
    assert config.load(["data.path=null"]).data.path is None
    assert config.load(["data.path=a=b.npz"]).data.path == "a=b.npz"


def test_a_config_survives_being_written_and_read() -> None:
    settings = config.load(["ablation=gp", "data.path=on", "sample.obstacle.x=0.25"])
    again = config.from_tree(yaml.safe_load(yaml.safe_dump(settings.tree())))
    assert again == settings
    assert again.sha() == settings.sha() != config.load(["ablation=gp"]).sha()


def test_the_accelerator_is_no_part_of_what_an_experiment_is() -> None:
    """So a run may go on with another, and records from before there was the setting are unchanged."""
    here, there = (config.load([f"train.accelerator={name}"]) for name in ("cpu", "auto"))
    assert here.train != there.train
    assert here.sha() == there.sha()
    assert "train.accelerator" not in config.flatten(here.identity())
    later = config.flatten(config.LATER)
    assert config.flatten(here.tree()).keys() - config.flatten(here.identity()).keys() == {
        "train.accelerator",
        *later,
    }


def test_a_setting_that_came_later_counts_where_it_is_not_its_default() -> None:
    """`LATER` says what the defaults are, for planners that read no YAML."""
    plain = config.load()
    for key, default in config.flatten(config.LATER).items():
        assert config.flatten(plain.tree())[key] == default
    for argument, value in {"sample.descent=5": 5, "train.precision=bf16": "bf16"}.items():
        other = config.load([argument])
        assert config.flatten(other.identity())[argument.partition("=")[0]] == value
        assert other.sha() != plain.sha()
    assert config.load(["train.precision=32"]).sha() == plain.sha()


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("ablation=cpg", "did you mean cgp?"),
        ("preset=quik", "did you mean quick?"),
        ("train.max_stepz=3", "did you mean train.max_steps?"),
        ("max_steps=3", "max_steps: no such setting"),
        ("sample.obstacle=3", "sample.obstacle: no such setting"),
        ("seed", "seed: expected key=value"),
        ("seed=-1", "seed=-1: expected a whole number of at least 0"),
        ("seed=1e3", "seed=1e3: expected a whole number"),
        ("train.max_steps=2.5", "train.max_steps=2.5: expected a whole number"),
        ("train.max_steps=0", "train.max_steps=0: expected a whole number of at least 1"),
        ("train.lr=0", "train.lr=0.0: expected a finite number above 0"),
        ("train.lr=nan", "train.lr=nan: expected a finite number"),
        ("train.lr=.inf", "train.lr=inf: expected a finite number"),
        ("train.lr=", "train.lr=: expected a finite number"),
        ("train.lr=fast", "train.lr=fast: expected a finite number"),
        ("data.negatives=maybe", "data.negatives=maybe: expected true or false"),
        ("data.amplitudes=0.3", "data.amplitudes=0.3: expected [a, b, ...]"),
        ("data.amplitudes=[]", "data.amplitudes=[]: expected at least one"),
        ("data.amplitudes=[2]", "data.amplitudes=[2.0]: expected"),
        ("source.kind=cpg", "source.kind=cpg: expected one of gaussian, gp, cgp"),
        ("correction.width=4", "correction.width=4: expected an odd number"),
        ("data.test_fraction=0.95", "data.test_fraction=0.95: expected less than 1 together with data.val_fraction"),
        ("train.lr=[", "train.lr=[: expected a finite number"),
        ("source.modes=0", "source.modes=0: expected a whole number or null of at least 1"),
        ("source.modes=1.5", "source.modes=1.5: expected a whole number or null"),
        (
            "data.negative_share=2",
            "data.negative_share=2.0: expected a finite number or null of at least 0 and at most 1",
        ),
        ("network.kind=mlp", "network.kind=mlp: expected one of resmlp, spectral"),
        ("correction.at=and", "correction.at=and: expected one of point, end"),
    ],
)
def test_a_bad_argument_is_refused_in_one_line_that_says_what_was_expected(argument: str, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        config.load([argument])
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_fitting_the_standard_normal_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"expected source\.kind gp or cgp"):
        config.load(["source.kind=gaussian", "source.fit=true"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["correction.at=end", "correction.path=guided"], "correction.path=guided: expected correction.at=point"),
        (["correction.at=end", "correction.mask=feasible"], "correction.mask=feasible: expected correction.at=point"),
        (["data.negative_share=0.1", "data.negatives=false"], "data.negative_share=0.1: expected data.negatives=true"),
        (["data.repair=true"], "correction.margin=0.0: expected a number above 0 where data.repair=true"),
        (["data.unrepaired=0.3"], "data.unrepaired=0.3: expected data.repair=true"),
        (["source.kind=gaussian", "network.kind=spectral"], "source.kind=gaussian: expected gp or cgp"),
        (["source.kind=gaussian", "correction.smoothing=covariant"], "source.kind=gaussian: expected gp or cgp"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(arguments: list[str], said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        config.load(arguments)
    assert said in str(refused.value)


@pytest.mark.parametrize("task", config.names("task"))
def test_a_task_is_chosen_by_its_name_and_says_how_many_demonstrations_it_has(task: str) -> None:
    assert task in TASKS
    assert task not in config.SWAPS or changes(f"task={task}") - {"task"} <= {"data.num"}
    settings = config.load([f"task={task}", "ablation=fm", "seed=3"])
    assert (settings.task, settings.task_name) == (task, task)
    assert settings.name == ("fm-s3" if task == "swap" else f"{task}-fm-s3")


def test_presets_and_arguments_win_over_tasks() -> None:
    assert config.load(["task=passing"]).data.num == 3000
    assert config.load(["task=passing", "preset=smoke"]).data.num == config.load(["preset=smoke"]).data.num != 3000
    assert config.load(["task=passing", "data.num=77"]).data.num == 77


@pytest.mark.parametrize("task", ["pasing", "", "my_task.PY", "my_task.py.txt", "../task/swap"])
def test_a_task_that_there_is_not_is_refused_with_the_names_of_all(task: str) -> None:
    with pytest.raises(ConfigError) as refused:
        config.load([f"task={task}"])
    known = ", ".join(config.names("task"))
    assert str(refused.value).startswith(f"task={task}: expected one of {known}, a file FILE.py")
    assert ("did you mean passing?" in str(refused.value)) == (task == "pasing")


@pytest.fixture
def task_file(tmp_path: Path) -> Path:
    """A file of a task of one's own; the config does not run it."""
    path = tmp_path / "two_arms.py"
    path.write_text("raise RuntimeError\n")
    return path


def test_a_file_is_a_task_that_is_called_as_it(task_file: Path) -> None:
    settings = config.load([f"task={task_file}", "ablation=plus", "seed=2"])
    assert (settings.task, settings.task_name) == (str(task_file), "two_arms")
    assert settings.name == "two_arms-plus-s2"
    assert config.from_tree(settings.tree()) == settings
    # All else is the same as without it.
    assert changes(f"task={task_file}") == {"task"}


@pytest.mark.parametrize("name", ["social.py", "elsewhere/swap.py"])
def test_a_file_that_is_called_as_a_named_task_is_to_be_renamed(name: str) -> None:
    """Runs, records and commands of both would have one name; whether there is such a file does not matter."""
    task = Path(name).stem
    with pytest.raises(ConfigError) as refused:
        config.load([f"task={name}"])
    expected = f"expected another name than that of the task {task}, for which its runs would be taken"
    assert str(refused.value) == f"task={name}: {expected}; try: rename the file"
    assert config.load(["task=my_social.py"]).task_name == "my_social"


def test_an_experiment_is_what_its_tasks_file_does_wherever_it_lies(task_file: Path, tmp_path: Path) -> None:
    """Neither a comment nor the folder changes it; a changed number does."""
    sha = config.load([f"task={task_file}"]).sha()
    other = tmp_path / "elsewhere" / task_file.name
    other.parent.mkdir()
    other.write_text("# a comment\nraise RuntimeError\n")
    assert config.load([f"task={other}"]).sha() == sha
    other.write_text("raise RuntimeError(1)\n")
    assert config.load([f"task={other}"]).sha() != sha
    assert config.load().sha() != sha


@pytest.mark.parametrize(
    "argument",
    [
        *("data.horizon=20", "data.amplitudes=[0.5]", "data.jitter=0.01", "constraint.radius=0.4"),
        *("sample.obstacle.x=0.2", "sample.obstacle.radius=0.2", "sample.radius=0.25", "sample.object_radius=0.1"),
    ],
)
def test_settings_of_swaps_are_refused_for_other_tasks(argument: str, task_file: Path) -> None:
    """Which would have no effect there: a file says what they do, and a crowd has settings of its own."""
    assert argument.startswith(OF_SWAPS)
    for task in (task_file, "weave"):
        with pytest.raises(ConfigError) as refused:
            config.load([f"task={task}", argument])
        assert str(refused.value) == f"{argument}: expected one of the tasks passing, social, swap, which it belongs to"
        if argument.startswith("sample."):
            with pytest.raises(ConfigError, match="^" + re.escape(str(refused.value))):
                config.override(config.load([f"task={task}"]), [argument], ["sample."])
    config.load(["task=passing", argument])


def test_the_tasks_of_two_robots_that_swap_sides_are_those_of_the_scene() -> None:
    assert set(config.SWAPS) == SWAPS.keys()
    assert TASKS.keys() == set(config.names("task"))


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("task.robots=[10, 20,28]", [10, 20, 28]),
        ("task.robots=3", 3),
        ("task.radius=5e-2", 0.05),  # which YAML 1.1 takes for a text
        ("task.radius=[1e-2, +.5E1]", [0.01, 5.0]),
        ("task.label=e5", "e5"),
        ("task.radius=0.05", 0.05),
        ("task.closed=true", True),
        ("task.label=a b${c}", "a b${c}"),
        ("task.limit=null", None),
    ],
)
def test_what_a_task_is_made_with_stands_beside_its_name(argument: str, value: object) -> None:
    """It goes through checkpoints, belongs to what the experiment is, and is not touched by OmegaConf."""
    settings = config.load(["task=weave", argument])
    name = argument.partition("=")[0]
    assert settings.of_task == {name.removeprefix("task."): value}
    assert settings.tree()[name] == value
    assert config.from_tree(settings.tree()) == settings
    assert settings.sha() != config.load(["task=weave"]).sha()
    assert config.override(settings, ["sample.steps=3"], ["sample."]).of_task == settings.of_task


def test_a_list_of_a_task_is_of_numbers() -> None:
    for argument in ("task.robots=[a, b]", f"task.robots={[1] * 65}"):
        with pytest.raises(ConfigError, match=r"expected \[a, b, \.\.\.\] of at most 64 numbers"):
            config.load(["task=weave", argument])


def test_the_lengths_of_a_task_and_of_an_ablation_both_multiply_those_of_the_preset() -> None:
    plain = config.load(["preset=long"])
    crowd = config.load(["preset=long", "task=weave", "ablation=plus"])
    assert crowd.train.max_steps == round(round(plain.train.max_steps * 2.25) * 0.4)
    assert crowd.train.batch_size == plain.train.batch_size / 16


def test_every_setting_of_swaps_is_one_and_all_others_are_taken(task_file: Path) -> None:
    flat = config.flatten(config.load().tree())
    for beginning in OF_SWAPS:
        assert any(key.startswith(beginning) for key in flat)
    taken = ("constraint.gamma=5", "constraint.pairs=all", "sample.num=20", "data.num=50", "data.path=x.npz")
    config.load([f"task={task_file}", *taken])


def test_pairs_are_the_nearest_or_all() -> None:
    assert config.load().constraint.pairs == "nearest"
    assert config.load(["constraint.pairs=all"]).constraint.pairs == "all"
    with pytest.raises(ConfigError, match=r"constraint\.pairs=each: expected one of nearest, all"):
        config.load(["constraint.pairs=each"])


def test_the_closest_approach_is_of_the_nearest_pair() -> None:
    """All pairs at all waypoints is the sum, whatever the reduction is called."""
    expected = "expected sum or mean where constraint.pairs=all, or constraint.pairs=nearest"
    with pytest.raises(ConfigError) as refused:
        config.load(["constraint.pairs=all", "constraint.reduction=closest"])
    assert str(refused.value) == f"constraint.reduction=closest: {expected}"
    for reduction in ("sum", "mean"):
        config.load(["constraint.pairs=all", f"constraint.reduction={reduction}"])
    config.load(["constraint.reduction=closest"])


def replaced(key: str, value: Any) -> Any:
    """The tree of the defaults with one value replaced, or without the key where it is ...; dotted keys nest."""
    tree = config.load().tree()
    *nesting, last = key.split(".")
    node = tree
    for name in nesting:
        node = node[name]
    if value is ...:
        del node[last]
    else:
        node[last] = value
    return tree


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("seed", ..., "seed: expected a value, found none"),
        ("sample.obstacle.y", ..., "sample.obstacle.y: expected a value, found none"),
        ("train", ..., "train: expected a value, found none"),
        ("sead", 3, "sead: no such setting, expected one of conf/base.yaml; did you mean seed?"),
        ("train.max_stepz", 3, "train.max_stepz: no such setting, expected one of conf/base.yaml; did you mean"),
        ("sample.obstacle.z", 0.1, "sample.obstacle.z: no such setting"),
        ("seed", "3", "seed=3: expected a whole number"),
        ("seed", 3.0, "seed=3.0: expected a whole number"),
        ("seed", True, "seed=True: expected a whole number"),
        ("seed", None, "seed=None: expected a whole number"),
        ("train.lr", "fast", "train.lr=fast: expected a finite number"),
        ("train.lr", True, "train.lr=True: expected a finite number"),
        ("train.lr", math.nan, "train.lr=nan: expected a finite number"),
        ("train.lr", math.inf, "train.lr=inf: expected a finite number"),
        ("train.lr", 10**400, "train.lr=1000"),
        ("data.negatives", 1, "data.negatives=1: expected true or false"),
        ("data.negatives", "true", "data.negatives=true: expected true or false"),
        ("data.path", 3, "data.path=3: expected a text without ${, or null"),
        ("data.path", "${oc.env:HOME}", "data.path=${oc.env:HOME}: expected a text without ${, or null"),
        ("ablation", ["cgp"], "ablation=['cgp']: expected a name"),
        ("task", None, "task=None: expected a name"),
        ("source.kind", "cpg", "source.kind=cpg: expected one of gaussian, gp, cgp"),
        ("source.kind", ["cgp"], "source.kind=['cgp']: expected one of gaussian, gp, cgp"),
        ("source.modes", 1.5, "source.modes=1.5: expected a whole number or null"),
        ("sample.radius", "null", "sample.radius=null: expected a finite number or null"),
        ("data.amplitudes", 0.3, "data.amplitudes=0.3: expected [a, b, ...]"),
        ("data.amplitudes", ["a"], "data.amplitudes=['a']: expected [a, b, ...]"),
        ("data.amplitudes", [True], "data.amplitudes=[True]: expected [a, b, ...]"),
        ("data.amplitudes", [0.1] * 65, "data.amplitudes=[0.1, 0.1"),
        ("data.amplitudes", [0.1, 2.0], "data.amplitudes=[0.1, 2.0]: expected [a, b, ...] of at most 64 numbers of at"),
        ("train", 3, "train=3: expected nested settings"),
        ("sample.obstacle", [0.0, 0.5, 0.1], "sample.obstacle=[0.0, 0.5, 0.1]: expected nested settings"),
        ("train.lr", {"value": 1e-3}, "train.lr={'value': 0.001}: expected a finite number"),
        ("sample.num", 1, "sample.num=1: expected a whole number of at least 2"),
        ("correction.width", 4, "correction.width=4: expected an odd number of taps"),
    ],
)
def test_a_tree_with_a_bad_value_is_refused_in_one_line(key: str, value: Any, said: str) -> None:
    """What a file holds may be from anywhere: its types are checked as those of arguments."""
    with pytest.raises(ConfigError) as refused:
        config.from_tree(replaced(key, value))
    assert str(refused.value).startswith(said)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 200


@pytest.mark.parametrize(
    "tree", [None, [], 3, "text", {}, {3: 4}, {None: {}}, {("seed",): 0}, {**replaced("seed", 0), 3: 4}]
)
def test_what_is_no_tree_of_settings_is_refused_in_one_line(tree: Any) -> None:
    with pytest.raises(ConfigError, match="expected") as refused:
        config.from_tree(tree)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [("train.lr", 1), ("sample.radius", None), ("source.modes", None), ("source.modes", 8), ("data.path", "on")],
)
def test_a_tree_may_hold_what_a_setting_may_be(key: str, value: Any) -> None:
    """A whole number stands for the number that it is, as in YAML, and the config is that of the argument."""
    settings = config.from_tree(replaced(key, value))
    found = config.flatten(settings.tree())[key]
    assert found == value
    assert isinstance(found, float) == (key == "train.lr")
    assert settings == config.load([f"{key}={'null' if value is None else value}"])


@pytest.mark.parametrize("ablation", config.names("ablation"))
def test_a_tree_gives_the_config_that_it_was_made_of(ablation: str) -> None:
    """Read from YAML, of the same types, with the same fingerprint."""
    settings = config.load([f"ablation={ablation}"])
    again = config.from_tree(yaml.safe_load(yaml.safe_dump(settings.tree())))
    assert again == settings
    assert json.dumps(again.tree()) == json.dumps(settings.tree())
    assert again.sha() == settings.sha()


HEAVY = {"torch", "numpy", "lightning", "mlflow", "omegaconf", "torchmetrics", "matplotlib", "scipy"}


@pytest.mark.parametrize(
    ("code", "needed"),
    [
        ("", set()),
        ("config.load(['preset=smoke', 'ablation=plus', 'task=passing'])", {"omegaconf"}),
        (f"config.from_tree({config.load(['preset=smoke']).tree()!r})", set()),
    ],
    ids=["import", "load", "from_tree"],
)
def test_settings_are_read_without_torch_and_a_tree_without_omegaconf(code: str, needed: set[str]) -> None:
    """A mistyped setting is answered at once, and a finished model is loaded with torch alone."""
    seen = loaded("-c", f"from conflow.training import config\n{code}")
    assert {"conflow.training.config", "conflow.flow.settings", "conflow.scene.settings"} <= seen
    assert HEAVY & {name.split(".")[0] for name in seen} == needed
