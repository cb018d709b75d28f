"""How long a training is going to take."""

import copy
from typing import Any

import pytest
import torch
from rich.console import Console

from conflow.training import config, forecast
from conflow.training.datamodule import DemonstrationData
from conflow.training.forecast import Forecast, duration, step_seconds
from tests.papers import model_of


class Trainer:
    """What the callback asks a Trainer for."""

    def __init__(self, *arguments: str, done: int = 0) -> None:
        settings = config.load(["preset=smoke", *arguments])
        self.datamodule = DemonstrationData(settings)
        self.max_steps, self.global_step = settings.train.max_steps, done
        self.model = model_of(settings)

    def said(self) -> str:
        console = Console(width=200)
        with console.capture() as captured:
            Forecast(console).on_train_start(self, self.model)  # type: ignore[arg-type]
        return captured.get()


@pytest.fixture
def seconds(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """What a step takes in each precision."""
    found = {"32": 0.3, "bf16": 0.1}
    monkeypatch.setattr(forecast, "step_seconds", lambda _, __, precision, ___: found[precision])
    return found


@pytest.mark.parametrize("precision", ["32", "bf16"])
def test_measuring_leaves_no_trace(precision: Any) -> None:
    """Neither in weights, gradients and random numbers, nor in the batches and the precision of what comes."""
    trainer = Trainer("ablation=plus", "source.fit=false")
    before, state = copy.deepcopy(trainer.model.state_dict()), torch.get_rng_state()
    batches = list(trainer.datamodule.train_dataloader())[:1]
    assert step_seconds(trainer.model, batches, precision, 3) > 0
    assert all(torch.equal(tensor, before[name]) for name, tensor in trainer.model.state_dict().items())
    assert all(weight.grad is None for weight in trainer.model.parameters())
    assert torch.equal(torch.get_rng_state(), state)
    assert not trainer.model.v.bf16


def test_at_most_a_hundredth_of_the_steps_and_about_a_second_are_spent(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = Trainer("train.max_steps=500")
    asked: list[object] = []
    trainer.model.v.register_forward_hook(lambda *_: asked.append(None))
    assert "500 steps of" in trainer.said()
    assert 2 <= len(asked) <= 6, "one that warms up, and five"
    asked.clear()
    monkeypatch.setattr(forecast, "BUDGET", 0.0)
    trainer.said()
    assert len(asked) == 1, "of what is slow one has to do"


def test_the_time_is_that_of_the_steps_that_are_left(seconds: dict[str, float]) -> None:
    assert Trainer("train.max_steps=20001", done=1).said() == (
        "20000 steps of 0.3 s on this machine: about 1 h 40 min of training; with train.precision=bf16 about 33 min\n"
    )
    assert Trainer("train.max_steps=20", done=20).said() == ""


@pytest.mark.parametrize(
    ("arguments", "other", "hint"),
    [
        (("train.max_steps=200",), 0.1, False),  # a minute is not worth it
        (("train.max_steps=20000",), 0.25, False),  # nor a sixth
        (("train.max_steps=20000",), 0.9, False),
        (("train.max_steps=20000",), 0.1, True),
    ],
)
def test_a_precision_is_hinted_at_where_it_saves_something(
    arguments: tuple[str, ...], other: float, hint: bool, seconds: dict[str, float]
) -> None:
    seconds["bf16"] = other
    assert ("with train.precision=bf16" in Trainer(*arguments).said()) == hint


def test_where_bf16_is_slow_32_is_hinted_at(seconds: dict[str, float]) -> None:
    seconds["bf16"] = 0.9
    said = Trainer("train.max_steps=20000", "train.precision=bf16").said()
    assert said.endswith("about 5 h 0 min of training; with train.precision=32 about 1 h 40 min\n")


def test_durations_are_rounded_to_what_one_wants_to_know() -> None:
    said = {0.034: "0.034 s", 59.6: "60 s", 125: "2 min", 5900: "98 min", 6180: "1 h 43 min", 90000: "25 h 0 min"}
    assert {seconds: duration(seconds) for seconds in said} == said
