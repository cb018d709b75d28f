"""A run that was interrupted goes on and ends as if nothing had happened, wherever it was stopped."""

import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from mlflow.entities import Run

from conflow.scene.tasks.swap import swap
from conflow.tracking import liveness
from tests.faults import processes
from tests.faults.processes import Death, checkpoint_folder, history, killed_in, runs, store, weights

# Steps 41 and points every 7: neither validations, every 10, nor the end fall on a logged step.
TRAIN = (
    *("train", "preset=smoke", "data.num=200", "train.max_steps=41", "train.val_every=10", "train.log_every=7"),
    *("train.batch_size=16", "sample.num=8", "sample.steps=3"),
)
STEP = ("conflow.training.module", "Training.training_step")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("resume")


@pytest.fixture(scope="module")
def whole(folder: Path) -> Run:
    """The run that nothing interrupts."""
    code, output = processes.run(folder, *TRAIN)
    assert code == 0, output
    return runs(folder)[0]


@pytest.mark.parametrize(
    "death",
    [
        killed_in("conflow.tracking.recording", "_describe"),
        killed_in(*STEP, call=6),
        killed_in(*STEP, call=26),
        killed_in("torch.optim", "AdamW.step", call=37),
        killed_in("conflow.training.module", "Training.validation_step", call=2),
        killed_in("conflow.training.module", "Training.sample", call=3),
        killed_in("os", "fsync", call=5),
        killed_in("pathlib", "Path.replace", call=2),
        killed_in("pathlib", "Path.replace", call=5),
        killed_in("conflow.training.train", "evaluate"),
        killed_in("conflow.figures.workspace", "save"),
    ],
    ids=[
        "before it had a config",
        "before the first checkpoint",
        "in mid-epoch",
        "before the weights change",
        "as validation begins",
        "during validation",
        "during a checkpoint",
        "before the old checkpoint is put aside",
        "before the new checkpoint has its name",
        "as the test begins",
        "as its artifacts are written",
    ],
)
def test_a_killed_run_ends_with_the_same_bits_as_one_that_never_was(death: Death, folder: Path, whole: Run) -> None:
    code, output = processes.run(folder, *TRAIN, death=death)
    assert code == -signal.SIGKILL, output
    before = runs(folder)[0]
    assert_ends_as(whole, folder, before)


def assert_ends_as(whole: Run, folder: Path, interrupted: Run) -> str:
    """Go on with the newest interrupted run; what that printed."""
    code, output = processes.run(folder, *TRAIN, "resume=latest")
    assert code == 0, output
    resumed = store(folder).get_run(interrupted.info.run_id)
    assert resumed.info.status == "FINISHED"
    expected = weights(whole)
    assert all(torch.equal(tensor, expected[name]) for name, tensor in weights(resumed).items())
    assert history(folder, resumed) == history(folder, whole)
    assert liveness.NOTE not in resumed.data.tags
    # What a finished run needs is among its artifacts.
    assert not checkpoint_folder(folder, resumed).exists()
    return output


def test_a_run_may_be_interrupted_again_and_again(folder: Path, whole: Run) -> None:
    assert processes.run(folder, *TRAIN, death=killed_in(*STEP, call=13))[0] == -signal.SIGKILL
    interrupted = runs(folder)[0]
    for _ in range(2):
        assert processes.run(folder, *TRAIN, "resume=latest", death=killed_in(*STEP, call=13))[0] == -signal.SIGKILL
    assert "from step 30 of 41" in assert_ends_as(whole, folder, interrupted)
    assert store(folder).get_run(interrupted.info.run_id).data.tags["resumed"] == "3"


def test_a_broken_checkpoint_is_named_and_the_one_before_it_is_used(folder: Path, whole: Run) -> None:
    assert processes.run(folder, *TRAIN, death=killed_in(*STEP, call=26))[0] == -signal.SIGKILL
    interrupted = runs(folder)[0]
    last = checkpoint_folder(folder, interrupted) / "last.ckpt"
    last.write_bytes(last.read_bytes()[:-1000])
    output = assert_ends_as(whole, folder, interrupted)
    assert f"{last.relative_to(folder)}: expected a checkpoint of ConFlow, found a damaged or foreign file" in output
    assert "from step 10 of 41" in output


def test_a_single_flipped_bit_in_the_weights_is_noticed(folder: Path, whole: Run) -> None:
    assert processes.run(folder, *TRAIN, death=killed_in(*STEP, call=13))[0] == -signal.SIGKILL
    interrupted = runs(folder)[0]
    last = checkpoint_folder(folder, interrupted) / "last.ckpt"
    content = bytearray(last.read_bytes())
    content[len(content) // 2] ^= 1
    last.write_bytes(content)
    output = assert_ends_as(whole, folder, interrupted)
    assert "found a damaged or foreign file" in output
    assert "from step 0 of 41" in output


def test_what_is_not_the_same_experiment_is_refused_with_the_differences(folder: Path, whole: Run) -> None:
    assert processes.run(folder, *TRAIN, death=killed_in(*STEP, call=13))[0] == -signal.SIGKILL
    interrupted = runs(folder)[0]
    refused = {
        ("resume=latest", "train.lr=0.5", "seed=3"): (
            "resume=cgp-s0: found seed=3, train.lr=0.5, expected the run's own seed=0, train.lr=0.001"
        ),
        ("resume=cgp-s1",): "no such run, expected latest, an id, NAME or PRESET/NAME; did you mean cgp-s0?",
        (f"resume={whole.info.run_id}",): "expected an interrupted run, found one that is FINISHED",
    }
    for arguments, said in refused.items():
        code, output = processes.run(folder, *TRAIN, *arguments)
        assert code == 2, output
        assert said in output
        assert len(output.splitlines()) == 1
    assert store(folder).get_run(interrupted.info.run_id).info.status == "KILLED"


def test_a_run_does_not_go_on_with_other_demonstrations(folder: Path, whole: Run) -> None:
    np.savez(folder / "demonstrations.npz", x=swap(100).numpy())
    arguments = [*TRAIN, "ablation=fm_mixed", "data.path=demonstrations.npz"]
    code, output = processes.run(folder, *arguments, death=killed_in(*STEP, call=13))
    assert code == -signal.SIGKILL, output
    np.savez(folder / "demonstrations.npz", x=swap(100, seed=1).numpy())
    code, output = processes.run(folder, *arguments, "resume=latest")
    assert code == 2
    assert "on which fm_mixed-s0 was trained" in output


def test_the_papers_preset_survives_being_cut_into_pieces(tmp_path: Path) -> None:
    """The preset itself, with its schedule, of a size that ends within the test."""
    asked = (*TRAIN, "preset=paper", "network.hidden=32", "network.blocks=1")
    code, output = processes.run(tmp_path, *asked)
    assert code == 0, output
    (whole,) = runs(tmp_path)
    assert processes.run(tmp_path, *asked, death=killed_in(*STEP, call=26))[0] == -signal.SIGKILL
    code, output = processes.run(tmp_path, *asked, "resume=latest")
    assert code == 0, output
    assert "from step 20 of 41" in output
    resumed = runs(tmp_path)[0]
    assert all(torch.equal(tensor, weights(whole)[name]) for name, tensor in weights(resumed).items())
    assert history(tmp_path, resumed) == history(tmp_path, whole)
