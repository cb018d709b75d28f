import os
import warnings
from pathlib import Path

import pytest
import torch
import yaml
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from mlflow.entities import Run

from conflow.errors import ConfigError
from conflow.training import config, train
from conflow.training.build import random_stream
from conflow.training.datamodule import DemonstrationData
from conflow.training.metrics import trajectory_metrics
from conflow.training.model_file import load_model
from conflow.training.reload import demonstrations
from tests.conftest import Command
from tests.faults.processes import runs, store
from tests.papers import SETTINGS, model_of

SETTINGS_ARGUMENTS = ["preset=smoke", "seed=3"]


@pytest.fixture(scope="module")
def trained(conflow: Command, workplace: Path) -> tuple[Run, str]:
    """A finished run, and what its command printed."""
    result = conflow("train", *SETTINGS_ARGUMENTS)
    assert result.returncode == 0, result.stderr
    return runs(workplace)[0], result.stdout


def artifacts(run: Run) -> Path:
    assert run.info.artifact_uri is not None
    return Path(run.info.artifact_uri.removeprefix("file://"))


def test_a_run_is_finished_named_tagged_and_has_every_setting(trained: tuple[Run, str]) -> None:
    run, _ = trained
    assert run.info.status == "FINISHED"
    assert run.info.run_name == "cgp-s3"
    settings = config.load(SETTINGS_ARGUMENTS)
    assert {key: run.data.tags[key] for key in ("task", "ablation", "preset", "seed", "config_sha")} == {
        "task": "swap",
        "ablation": "cgp",
        "preset": "smoke",
        "seed": "3",
        "config_sha": settings.sha(),
    }
    assert {"git_sha", "git_dirty", "host"} <= set(run.data.tags)
    assert run.data.params == {key: str(value) for key, value in config.flatten(settings.identity()).items()}
    assert config.from_tree(yaml.safe_load((artifacts(run) / "config.yaml").read_text())) == settings


def test_a_run_holds_the_documented_metrics(trained: tuple[Run, str]) -> None:
    run, _ = trained
    expected = {"train/loss", "train/grad_norm", "train/steps_per_second", "train/seconds", "val/loss"}
    for setting in SETTINGS:
        swept = ("robot_collision_swept", "object_collision_swept")
        for metric in ("robot_collision", "object_collision", *swept, "near", "success", "outside"):
            expected |= {f"test/{setting}/{metric}_{part}" for part in ("rate", "low", "high", "count")}
        values = ("smoothness_median", "smoothness_p95", "start_error", "end_error", "diversity", "energy_distance")
        for metric in (*values, "path_length_median"):
            expected |= {f"test/{setting}/{metric}{part}" for part in ("", "_low", "_high")}
        expected |= {f"test/{setting}/{name}" for name in ("latency_ms", "num", "start_drift", "end_drift")}
    expected |= {key.replace("test/", "validation/") for key in expected}
    expected |= {f"without_model/{what}/robot_collision_count" for what in ("data", "feasible", "source")}
    assert expected <= set(run.data.metrics)


def test_metrics_are_logged_by_step(trained: tuple[Run, str], workplace: Path) -> None:
    run, _ = trained
    for key, steps in {
        "train/loss": [10, 20, 30, 40],
        "val/loss": [20, 40],
        "test/none/num": [0],
        "validation/none/num": [0],
    }.items():
        assert [metric.step for metric in store(workplace).get_metric_history(run.info.run_id, key)] == steps


def test_the_data_set_is_an_input_with_its_digest(trained: tuple[Run, str]) -> None:
    run, _ = trained
    data = DemonstrationData(config.load(SETTINGS_ARGUMENTS))
    assert run.inputs is not None
    assert [entry.dataset.digest for entry in run.inputs.dataset_inputs] == [data.digest]


def test_the_pictures_are_there(trained: tuple[Run, str]) -> None:
    run, _ = trained
    for name in ("page", "demonstrations", "sources"):
        assert (artifacts(run) / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_closes_with_the_metrics_and_the_way_to_the_pages(trained: tuple[Run, str]) -> None:
    run, output = trained
    assert f"{run.data.metrics['validation/none/energy_distance']:.4f}" in output
    assert "cgp-s3, preset smoke, validation split" in output
    assert "make ui" in output.splitlines()[-1]


@pytest.mark.parametrize(("split", "group"), [("test", "test"), ("val", "validation")])
def test_a_reloaded_model_samples_what_the_run_was_measured_on(
    split: config.SplitName, group: str, trained: tuple[Run, str]
) -> None:
    run, _ = trained
    model = load_model(artifacts(run) / "model.ckpt")
    held_out = DemonstrationData(model.config).held_out[split].x
    x_1, reference = held_out[torch.arange(64) % 50], held_out[~model.judged["robot"].violation(held_out)]
    for setting in SETTINGS:
        x = model.sample(x_1, setting, random_stream(f"{split} samples", 3))
        metrics = trajectory_metrics(model.judged, model.trained, reference, model.required(setting))
        metrics.update(x=x, x_1=x_1)
        for key, value in metrics.compute().items():
            # To the bit but for the order of sums: training and test may run on other numbers of threads.
            assert run.data.metrics[f"{group}/{setting}/{key}"] == pytest.approx(value, rel=1e-5)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("ablation=cpg",), "did you mean cgp?"),
        (("split=train",), "split=train: expected val or test"),
        (("train.max_stepz=3",), "did you mean train.max_steps?"),
        (("train.lr=-1",), "train.lr=-1.0: expected a finite number above 0"),
        (("preset=smoke", "data.path=missing.npz"), "data.path=missing.npz: no such file"),
    ],
)
def test_a_bad_command_ends_in_one_line_before_anything_is_tracked(
    arguments: tuple[str, ...], said: str, conflow: Command, workplace: Path, trained: tuple[Run, str]
) -> None:
    before = len(runs(workplace))
    result = conflow("train", *arguments)
    assert result.returncode == 2
    assert said in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert len(runs(workplace)) == before


@pytest.mark.parametrize(
    ("options", "split", "mark"), [(["split=test"], "test", ""), (["split=val"], "val", "val "), ([], "val", "val ")]
)
def test_evaluating_again_adds_to_the_run_and_changes_nothing_that_it_had(
    options: list[str], split: config.SplitName, mark: str, conflow: Command, workplace: Path, trained: tuple[Run, str]
) -> None:
    before, _ = trained
    settings = ["sample.steps=5", "sample.steps=3", "sample.solver=midpoint", "seed=8"]  # of two the last counts
    result = conflow("evaluate", f"run={before.info.run_id}", *settings, *options)
    assert result.returncode == 0, result.stderr
    assert f"seed:8, {config.SPLITS[split]} split" in " ".join(result.stdout.split())
    after = store(workplace).get_run(before.info.run_id)
    assert after.info.status == "FINISHED"
    assert before.data.metrics.items() <= after.data.metrics.items()
    prefix = f"evaluate/{mark}sample.solver:midpoint sample.steps:3 seed:8"
    model = load_model(artifacts(before) / "model.ckpt", settings)
    x_1 = DemonstrationData(model.config).held_out[split].x[torch.arange(64) % 50]
    x = model.sample(x_1, "robot", random_stream(f"{split} samples", 8))
    counted = after.data.metrics[f"{prefix}/robot/robot_collision_count"]
    assert counted == model.judged["robot"].violation(x).sum()
    assert (artifacts(before) / f"{prefix}.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("network.hidden=3",), "network.hidden=3: fixed by the run"),
        (("run=cgp-s33",), "run=cgp-s33: no such finished run"),
        (("sample.stepz=3",), "did you mean sample.steps?"),
    ],
)
def test_what_a_finished_run_cannot_be_asked_is_refused(
    arguments: tuple[str, ...], said: str, conflow: Command, trained: tuple[Run, str]
) -> None:
    result = conflow("evaluate", *arguments)
    assert result.returncode == 2
    assert said in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_run_is_not_judged_on_data_that_have_changed_since(trained: tuple[Run, str]) -> None:
    run, _ = trained
    assert demonstrations(run, model_of(config.load(SETTINGS_ARGUMENTS))).digest == run.data.tags["data_digest"]
    with pytest.raises(ConfigError, match="on which cgp-s3 was trained"):
        demonstrations(run, model_of(config.load([*SETTINGS_ARGUMENTS, "data.seed=1"])))


def test_a_machine_with_slurm_hears_no_advice_that_is_not_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    srun = tmp_path / "srun"
    srun.touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    with warnings.catch_warnings(record=True) as advised:
        warnings.simplefilter("always")
        SLURMEnvironment.detect()
        assert len(advised) == 1
        train._quiet()
        SLURMEnvironment.detect()
    assert len(advised) == 1
