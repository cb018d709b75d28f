"""What each of several processes knows of the others."""

import pytest
import torch

from conflow.errors import ConfigError
from conflow.tracking import ranks
from conflow.training import config, memory
from conflow.training.datamodule import DemonstrationData
from conflow.training.train import check_shares


def be(rank: int, world: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make this process one of several."""
    environment = {"TORCHELASTIC_RUN_ID": "test", "RANK": str(rank), "WORLD_SIZE": str(world)}
    for name, value in (environment | {"LOCAL_WORLD_SIZE": str(world), "LOCAL_RANK": str(rank)}).items():
        monkeypatch.setenv(name, value)


def test_a_process_that_torchrun_did_not_start_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else has set these variables."""
    for name in ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE"):
        monkeypatch.setenv(name, "3")
    assert (ranks.rank(), ranks.world(), ranks.on_node(), ranks.share(10)) == (0, 1, 1, slice(0, 10))
    assert ranks.of_first(lambda: 5) == 5
    assert ranks.each("a") == ["a"]
    assert ranks.first_says(True)
    assert not ranks.lost(RuntimeError("gloo"))


@pytest.mark.parametrize("world", [1, 2, 3, 8])
def test_the_shares_are_the_batch(world: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, found = list(range(48)), []
    for rank in range(world):
        be(rank, world, monkeypatch)
        assert len(rows[ranks.share(48)]) == 48 // world
        found += rows[ranks.share(48)]
    assert found == rows


@pytest.mark.parametrize(
    ("arguments", "size"),
    [
        (["train.batch_size=65"], 65),
        (["train.batch_size=65", "data.negative_share=0.1"], 65),
        (["task=weave", "ablation=plus", "task.robots=[2,3]", "train.batch_size=6"], 9),  # the smaller scene's
    ],
)
def test_a_batch_that_does_not_divide_is_refused(
    arguments: list[str], size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = config.load(["preset=smoke", "data.num=60", *arguments])
    data = DemonstrationData(settings)
    check_shares(settings, data)
    be(0, 2, monkeypatch)
    with pytest.raises(ConfigError, match=f"train.batch_size={settings.train.batch_size}: found batches of {size}, "):
        check_shares(settings, data)


def test_more_processes_than_gpus_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for world in (1, 2):
        be(0, world, monkeypatch)
        memory.check_training(config.load())
    be(0, 3, monkeypatch)
    memory.check_training(config.load(["train.accelerator=cpu"]))
    for accelerator in ("auto", "gpu"):
        with pytest.raises(ConfigError) as refused:
            memory.check_training(config.load([f"train.accelerator={accelerator}"]))
        assert str(refused.value) == (
            f"train.accelerator={accelerator}: found 3 processes on a machine that has 2 GPUs for them, expected cpu"
        )
