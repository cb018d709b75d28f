import pytest
import yaml

from conflow.experiment import config
from conflow.experiment.config import CONF, ConfigError

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
CHANGES["plus"] = (CHANGES["end"] | CHANGES["spectral"] | CHANGES["fitted"] | CHANGES["few_steps"]) | {
    "constraint.gamma",
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


@pytest.mark.parametrize("preset", ["long", "paper", "quick", "smoke"])
def test_a_preset_says_how_much_compute_and_nothing_about_the_method(preset: str) -> None:
    assert all(
        key.split(".")[0] in {"preset", "network", "train"} or key in {"data.num", "sample.num", "sample.steps"}
        for key in changes(f"preset={preset}")
    )


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
        (["data.negative_share=0.1", "data.negatives=false"], "data.negative_share=0.1: expected data.negatives=true"),
        (["data.repair=true", "data.negatives=false"], "data.repair=True: expected data.negatives=true"),
        (["data.repair=true"], "correction.margin=0.0: expected a number above 0 where data.repair=true"),
        (["source.kind=gaussian", "network.kind=spectral"], "source.kind=gaussian: expected gp or cgp"),
        (["source.kind=gaussian", "correction.smoothing=covariant"], "source.kind=gaussian: expected gp or cgp"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(arguments: list[str], said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        config.load(arguments)
    assert said in str(refused.value)
