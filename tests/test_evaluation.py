"""What an evaluation holds, and the comparison of demonstrations with their own feasible part."""

import io
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from lightning.pytorch.loggers import Logger
from rich.console import Console
from torch import Tensor

from conflow.scene.constraint import RobotAvoidance
from conflow.scene.robots import Discs
from conflow.scene.tasks.swap import swap
from conflow.training import config, summary
from conflow.training.datamodule import DemonstrationData, Split
from conflow.training.evaluation import Evaluation, cycle, evaluate
from conflow.training.model import ConFlow
from conflow.training.module import Training
from conflow.training.progress import ProgressDisplay
from conflow.training.train import trainer
from tests.papers import SETTINGS, model_of


def model() -> Training:
    torch.manual_seed(0)
    return model_of(config.load(["preset=smoke", "sample.steps=1"]), 32, 4).eval()


def evaluated(demonstrations: Tensor, M: Tensor | None = None) -> Evaluation:
    M = violates(demonstrations) if M is None else M
    with ProgressDisplay(Console(file=io.StringIO())) as display:
        return evaluate(model(), Split(demonstrations, M), display)


@pytest.fixture(scope="module")
def evaluation() -> Evaluation:
    return evaluated(swap(200))


class Differentiated(RobotAvoidance):
    """A constraint without a gradient in closed form."""

    def gradient(self, x: Tensor) -> Tensor:
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            return torch.autograd.grad(self.barrier(x).sum(), x)[0]


class Silent(Logger):
    """A logger that keeps nothing."""

    name = version = run_id = "silent"

    def log_metrics(self, *_: Any, **__: Any) -> None:
        pass

    def log_hyperparams(self, *_: Any, **__: Any) -> None:
        pass


def test_a_gradient_that_autograd_takes_serves_as_well_as_one_in_closed_form(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In training, validation and evaluation; both gradients are the same to rounding."""
    monkeypatch.chdir(tmp_path)
    settings = config.load(["preset=smoke", "train.max_steps=4", "train.val_every=2", "sample.num=8", "sample.steps=4"])
    data = DemonstrationData(settings)
    results = []
    for avoidance in (Differentiated, RobotAvoidance):
        torch.manual_seed(0)
        flow = model_of(settings, data.T, data.D)
        flow.u_c.constraint = avoidance(Discs(2))
        with ProgressDisplay(Console(file=io.StringIO())) as display:
            trainer(settings, cast(Any, Silent()), data, display).fit(flow, data)
            results.append(evaluate(flow.eval(), data.test, display).samples)
    # Single precision, through a few steps of training.
    torch.testing.assert_close(results[0], results[1], rtol=0, atol=1e-4)


def violates(x: Tensor) -> Tensor:
    return model().judged["robot"].violation(x)


def test_every_setting_and_baseline_has_the_guards(evaluation: Evaluation) -> None:
    guards = {"success_rate", "outside_rate", "path_length_median", "energy_distance"}
    assert all(guards <= evaluation.results[setting].keys() for setting in SETTINGS)
    assert evaluation.baseline.keys() == {"data", "feasible", "source"}
    assert all(guards <= evaluation.baseline[name].keys() for name in ("data", "source"))


def test_demonstrations_succeed_where_they_do_not_collide(evaluation: Evaluation) -> None:
    """Of these none passes between two waypoints what it does not pass at them."""
    data, feasible = evaluation.baseline["data"], evaluation.baseline["feasible"]
    assert data["success_count"] == feasible["num"] == int((~violates(swap(200))).sum())
    assert (feasible["success_rate"], feasible["robot_collision_rate"], feasible["outside_rate"]) == (1, 0, 0)


def test_success_around_the_obstacle_misses_the_obstacle_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a flow that returns the demonstrations themselves, which reach their own starts and goals."""
    x = swap(200)
    x_1 = cycle(x, 64)
    monkeypatch.setattr(ConFlow, "flow", lambda *_: x_1)
    found = evaluated(x)
    apart = model().judged["robot"].swept_clearance(x_1).amin(dim=1) >= 0
    free = model().judged["object"].swept_clearance(x_1).amin(dim=1) >= 0
    succeed = {setting: found.results[setting]["success_count"] for setting in SETTINGS}
    assert succeed == {"none": apart.sum(), "robot": apart.sum(), "obstacle": (apart & free).sum()}
    assert 0 < succeed["obstacle"] < succeed["none"] < 64
    assert found.baseline["data"]["success_count"] > succeed["none"]  # of all 200, without the obstacle


def test_the_splits_have_noise_of_their_own_and_the_latencies_in_common(evaluation: Evaluation) -> None:
    x = swap(200)
    with ProgressDisplay(Console(file=io.StringIO())) as display:
        found = evaluate(model(), Split(x, violates(x)), display, "val", timed=evaluation)
    assert not torch.equal(found.source_samples, evaluation.source_samples)  # for the same starts and goals
    assert found.baseline == {}
    for setting in SETTINGS:
        assert found.results[setting].keys() == evaluation.results[setting].keys()
        assert found.results[setting]["latency_ms"] == evaluation.results[setting]["latency_ms"]


def test_the_feasible_demonstrations_have_no_distance_to_themselves(evaluation: Evaluation) -> None:
    assert "energy_distance" not in evaluation.baseline["feasible"]
    assert "without_model/feasible/robot_collision_rate" in evaluation.keyed()


def test_the_distance_of_the_demonstrations_to_their_feasible_part_is_that_of_the_mixture(
    evaluation: Evaluation,
) -> None:
    """2 E|X - Y| - E|X - X'| - E|Y - Y'| with X of D- with probability p, else of D+, and Y of D+."""
    x = swap(200).flatten(1).double()
    negatives, feasible = x[violates(swap(200))], x[~violates(swap(200))]
    p = len(negatives) / 200
    between = float(torch.cdist(negatives, feasible).mean())
    within_negatives, within_feasible = (float(torch.pdist(part).mean()) for part in (negatives, feasible))
    cross = p * between + (1 - p) * within_feasible
    within = p**2 * within_negatives + 2 * p * (1 - p) * between + (1 - p) ** 2 * within_feasible
    found = evaluation.baseline["data"]
    assert found["energy_distance"] == pytest.approx(2 * cross - within - within_feasible, rel=1e-6)
    assert found["energy_distance_low"] < found["energy_distance"] < found["energy_distance_high"]


def test_feasible_is_what_is_labelled_so() -> None:
    """A user's labels, or those of another radius than samples are judged at."""
    x = swap(200)
    M = torch.arange(200) % 2 == 0
    found = evaluated(x, M).baseline["feasible"]
    assert (found["num"], found["robot_collision_count"]) == (100, int(violates(x[~M]).sum()))


@pytest.mark.parametrize(("feasible", "infeasible", "has"), [(0, 5, set()), (1, 5, set()), (5, 1, {"source"})])
def test_too_few_demonstrations_leave_the_energy_distance_out(feasible: int, infeasible: int, has: set[str]) -> None:
    x = swap(200)
    found = evaluated(torch.cat([x[~violates(x)][:feasible], x[violates(x)][:infeasible]]))
    assert {name for name, metrics in found.baseline.items() if "energy_distance" in metrics} == has
    assert ("feasible" in found.baseline) == (feasible > 1)
    assert ("energy_distance" in found.results["none"]) == (feasible > 1)
    console = Console(file=io.StringIO(), record=True, width=200)
    console.print(summary.results_table(found, "few"))
    printed = console.export_text()
    assert "energy distance" in printed
    assert "ms for a batch of 256" in printed
