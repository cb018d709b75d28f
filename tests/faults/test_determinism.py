"""Same seed, same machine, same bytes: two processes that know nothing of each other."""

from pathlib import Path

import pytest
import torch

from tests.faults import processes
from tests.faults.processes import history, runs, weights

TINY = (
    *("train", "preset=smoke", "data.num=200", "train.max_steps=20", "train.val_every=10", "train.batch_size=16"),
    *("sample.num=8", "sample.steps=3"),
)
PLAN = ("sample", "start=-0.8,0,0.8,0", "goal=0.8,0,-0.8,0", "num=8")


@pytest.mark.parametrize("ablation", ["cgp", "plus"])
def test_two_processes_of_the_same_seed_make_the_same_bytes(ablation: str, tmp_path: Path) -> None:
    asked = (*TINY, f"ablation={ablation}")
    for number in range(2):
        for command in (asked, (*PLAN, f"out=plans-{number}.npz"), ("demonstrations", f"out=data-{number}.npz")):
            code, output = processes.run(tmp_path, *command)
            assert code == 0, output
    for name in ("plans", "data"):
        assert (tmp_path / f"{name}-0.npz").read_bytes() == (tmp_path / f"{name}-1.npz").read_bytes()
    second, first = runs(tmp_path)
    assert all(torch.equal(tensor, weights(second)[name]) for name, tensor in weights(first).items())
    assert history(tmp_path, first) == history(tmp_path, second)
    code, output = processes.run(tmp_path, *asked, "seed=1")
    assert code == 0, output
    other = runs(tmp_path)[0]
    assert any(not torch.equal(tensor, weights(other)[name]) for name, tensor in weights(first).items())
    assert history(tmp_path, other) != history(tmp_path, first)


def test_a_training_that_diverges_stops_at_the_step_and_names_what_is_left(tmp_path: Path) -> None:
    code, output = processes.run(tmp_path, *TINY, "train.lr=1e9", "train.schedule=constant", "train.val_every=2")
    assert code == 2, output
    (said,) = [line for line in output.splitlines() if line.startswith("conflow:")]
    assert "expected a finite number: step 1, batch of seed 0 and step 1, train.lr=1e+09" in said
    assert said.endswith("there is no checkpoint from before")
    assert runs(tmp_path)[0].info.status == "FAILED"
