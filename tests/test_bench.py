"""What the bench says: that it compares equal things, in turn, and counts every second once."""

import json
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

from conflow.errors import ConfigError
from conflow.flow.path import interpolate, velocity
from conflow.flow.sampler import integrate
from conflow.scene.tasks.swap import swap
from conflow.tracking import store
from conflow.training import config
from conflow.training.build import build_source
from tests.bench import peers, quality, sampling, scaling, suite, table, training, whole
from tests.bench.clock import Pace, Row, Target, alone, alternate, beside, block, compared
from tests.bench.quality import Curve
from tests.bench.suite import Bench
from tests.bench.training import RAW, Loop, RawLoop

ONCE = Pace(rounds=1, at_least=0)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_everything_has_its_turn_in_every_round_and_another_one_is_first() -> None:
    order: list[str] = []

    def noted(name: str) -> Any:
        def run(times: int) -> float:
            order.append(name)
            return 0.1 * times

        return run

    seconds = alternate({"a": noted("a"), "b": noted("b")}, Pace(rounds=3, at_least=0.3))
    assert order[4:] == ["a", "b", "b", "a", "a", "b"]  # after two calls of each, to warm up and to be timed
    assert seconds == {"a": [pytest.approx(0.1)] * 3, "b": [pytest.approx(0.1)] * 3}


def test_a_ratio_is_of_the_same_round() -> None:
    """A machine that is three times slower in one round changes no ratio."""
    ours, theirs = [1.0, 3.0, 1.0], [2.0, 6.0, 2.0]
    for kind, ratio in {"speed": 2.0, "time": 0.5, "share": 0.5}.items():
        row = compared("part", "what", "other", ours, theirs, kind)  # type: ignore[arg-type]  # one of its kinds
        assert (row.ratio, row.low, row.high) == (ratio, ratio, ratio)
        assert (row.ours, row.theirs) == (1.0, 2.0)


def test_a_block_takes_as_long_as_what_it_repeats() -> None:
    assert block(lambda: time.sleep(0.01))(3) >= 0.03


def test_a_peer_that_is_absent_is_named() -> None:
    found = beside("part", "what", block(lambda: None), {"here": block(lambda: None), "gone": None}, ONCE)
    assert [(row.beside, row.note, row.ratio is None) for row in found] == [
        ("here", "", False),
        ("gone", "not installed", True),
    ]


@pytest.mark.parametrize(
    ("target", "ratio", "said"),
    [
        (Target(1.03), 1.02, "at most 1.03: met"),
        (Target(1.03), 1.236, "at most 1.03: missed, 1.20 times that"),
        (Target(20, at_most=False), 30, "at least 20: met"),
        (Target(20, at_most=False), 5, "at least 20: missed, 0.25 times that"),
    ],
)
def test_a_target_is_met_or_the_distance_is_said(target: Target, ratio: float, said: str) -> None:
    row = Row("part", "what", "other", 1.0, 1.0, "time", ratio, ratio, ratio, target)
    assert table.line(row)[-1] == said


def test_the_raw_loop_is_the_same_mathematics(smoke: config.Config) -> None:
    """Its source has our mean and covariance, its x_t and target are ours to rounding."""
    raw = RawLoop(smoke)
    source = build_source(smoke.source, 32)
    torch.testing.assert_close(raw.W, source.mean_map.float(), rtol=0, atol=1e-5)
    torch.testing.assert_close((raw.L @ raw.L.mT).double(), source.covariance, rtol=0, atol=1e-6)
    x_1 = swap(100)
    M, t = raw.model.judged["robot"].violation(x_1), torch.rand(100, generator=generator())
    x_0 = source.sample(source.observe(x_1), generator())
    x_t, target = raw.target(x_0, x_1, t, M)
    torch.testing.assert_close(x_t, interpolate(x_0, x_1, t), rtol=0, atol=1e-6)
    ours = velocity(x_0, x_1) + 2.5 * M[:, None, None] * raw.model.u_c(interpolate(x_0, x_1, t))
    torch.testing.assert_close(target, ours, rtol=0, atol=1e-5)
    assert (target - velocity(x_0, x_1)).abs().max() > 0.1


def test_a_raw_step_learns(smoke: config.Config) -> None:
    raw = RawLoop(smoke)
    before = [p.clone() for p in raw.model.v.parameters()]
    assert raw.run(2) > 0
    assert all(not torch.equal(p, q) for p, q in zip(before, raw.model.v.parameters(), strict=True))


def test_other_libraries_solve_and_interpolate_the_same() -> None:
    """Whoever is here gives our numbers, so their times are of the same work."""
    x_0, x_1, t = swap(5, seed=1), swap(5), torch.rand(5, generator=generator())

    def v(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return torch.sin(3 * x) + t[:, None, None]

    for path in filter(None, peers.paths().values()):
        x_t, u_t = path(x_0, x_1, t)
        torch.testing.assert_close(x_t, interpolate(x_0, x_1, t))
        torch.testing.assert_close(u_t, velocity(x_0, x_1))
    for solve in filter(None, peers.solvers().values()):
        for method in ("euler", "midpoint"):
            torch.testing.assert_close(
                solve(v, x_0, 8, method), integrate(v, x_0, 8, "euler" if method == "euler" else "midpoint")
            )
    assert peers.solvers()["torchdiffeq"] is not None  # an oracle of other tests, so it is here


@pytest.mark.parametrize("name", list(peers.processes()))
def test_other_libraries_draw_from_the_same_process(name: str) -> None:
    """Their samples have the ends asked for and the variance of ours in the middle."""
    make = peers.processes()[name]
    if make is None:
        pytest.skip(f"{name} is not installed")
    source = build_source(config.load().source, 32)
    y = source.observe(swap(1)).expand(600, -1, -1)
    torch.manual_seed(0)
    drawn = torch.as_tensor(make(torch.linspace(0, 1, 32), y)()).squeeze()
    # gpytorch has a process for each trajectory and dimension, scikit-learn one with as many targets.
    x = drawn.float() if drawn.ndim == 3 else drawn.float().mT.unflatten(0, (600, 4))
    torch.testing.assert_close(x[..., [0, -1]], y.mT, rtol=0, atol=0.06)  # their observations have some noise
    # 600 samples in each of 4 dimensions estimate a variance to 3 % (one standard deviation).
    for waypoint in (8, 16):
        variance = x[..., waypoint].var(dim=0).mean().item()
        assert variance == pytest.approx(float(source.covariance[waypoint, waypoint]), rel=0.15)


def test_the_loop_is_that_of_training_without_a_validation(elsewhere: Path, smoke: config.Config) -> None:
    longer = replace(smoke, train=replace(smoke.train, max_steps=1000, val_every=500))
    with Loop(longer) as loop:
        first = [p.clone() for p in loop.model.v.parameters()]
        assert loop.run(12) > 0
        assert any(not torch.equal(p, q) for p, q in zip(first, loop.model.v.parameters(), strict=True))
        run_id = str(loop.logger.run_id)
    history = store.client().get_run(run_id).data.metrics
    assert "train/loss" in history  # logged at step 10
    assert "val/loss" not in history


def test_training_is_compared_with_everything(elsewhere: Path) -> None:
    found = training.rows("smoke", ONCE)
    names = {row.beside for row in found}
    assert {RAW, "raw loop, torchcfm's path", "raw loop, flow_matching's path", "the raw step"} <= names
    shares = {row.what: row.ratio for row in found if row.kind == "share"}
    assert {"source", "path", "correction", "network, forward and back", "optimiser"} <= set(shares)
    parts = sum(shares[name] or 0 for name in ("source", "path", "correction"))
    assert shares["source + path + correction"] == pytest.approx(parts)


def test_the_rest_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"LATENCIES": 5, "MILLION": 1000, "SAMPLES": 32, "LATENCY_BATCH": 4}.items():
        monkeypatch.setattr(sampling, name, value)
    found = [
        *sampling.source(ONCE),
        *sampling.correction(ONCE),
        *sampling.ode(ONCE),
        *sampling.plan(ONCE),
        *sampling.demonstrations(),
        *sampling.start(ONCE),
    ]
    assert all(row.ratio is not None or row.note == "not installed" for row in found)
    assert {row.what for row in found if row.target} == {
        "source",
        "250 Euler steps",
        "plus: 20 evaluations",
        "planner.plan",
        "conflow --help",
    }


def test_memory_is_what_tensors_take_at_once() -> None:
    def call() -> None:
        for _ in range(3):
            a = torch.ones(1000, 1000)
            b = a + 1
            del a, b

    assert scaling.peak(call) == pytest.approx(8e6, rel=0.01)


def test_growth_is_drawn_for_every_axis() -> None:
    sizes = {"batch": (1, 2), "samples": (3, 4)}
    found = [scaling.Point(axis, size, 1e-3 * size, 1.0) for axis, of in sizes.items() for size in of]
    figure = scaling.figure(found)
    assert [axis.get_xlabel() for axis in figure.axes[-2:]] == list(sizes)


def test_a_second_is_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What one section calls of another belongs to the outer one; the loop's count as often as it was cut short."""
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])

    class Program:
        def outer(self) -> None:
            clock[0] += 3
            self.inner()

        def inner(self) -> None:
            clock[0] += 1

        def fit(self) -> None:
            clock[0] += 2
            self.inner()

    monkeypatch.setattr(whole, "SECTIONS", {"outer": [(Program, "outer")], "inner": [(Program, "inner")]})
    monkeypatch.setattr(whole, "Trainer", Program)
    tally = whole.Tally()
    with tally.taken():
        program = Program()
        program.outer()
        program.inner()
        program.fit()
    assert tally.seconds == {"outer": 4, "inner": 1 + whole.SHORTER, "training": 2 * whole.SHORTER}
    assert Program.outer.__name__ == "outer"  # everything is as it was


def test_the_shares_of_a_run_add_up(elsewhere: Path) -> None:
    found = {row.what: row for row in whole.rows("smoke")}
    assert set(found) == {"training", *whole.SECTIONS, whole.BOTH}
    assert all(row.ratio is not None and row.ratio > 0 for row in found.values())
    whole_run = sum(row.ratio or 0 for name, row in found.items() if name != whole.BOTH)
    assert 0.3 < whole_run <= 1.0  # the rest: making data and model


def test_curves_are_those_of_finished_runs_of_an_ablation(elsewhere: Path) -> None:
    """Measured more often a run still counts; with another training, or without its seconds, it does not."""
    client = store.client()
    experiment = client.get_experiment_by_name("conflow")
    assert experiment is not None
    for seed, changes, timed in (
        (0, [], True),
        (1, ["train.val_every=10"], True),
        (2, ["train.lr=1"], True),
        (3, [], False),
    ):
        settings = config.load(["preset=smoke", f"seed={seed}", *changes])
        tags = {"ablation": "cgp", "preset": "smoke", "seed": str(seed), "hardware": "a machine", "threads": "2"}
        run_id = client.create_run(experiment.experiment_id, tags=tags).info.run_id
        for key, value in config.flatten(settings.tree()).items():
            client.log_param(run_id, key, str(value))
        for step in (10, 20, 30):
            client.log_metric(run_id, "val/none/robot_collision_count", 7 - step // 10, step=step)
            if timed and step > 10:
                client.log_metric(run_id, "train/seconds", step / 10, step=step)
        client.set_terminated(run_id, "FINISHED")
    found = quality.curves("smoke")
    assert [(one.ablation, one.seed) for one in found] == [("cgp", 0), ("cgp", 1)]
    assert found[0] == Curve("cgp", 0, [20, 30], [2.0, 3.0], [5, 4], 64, "a machine, 2 threads")


def curve(ablation: str, counts: list[int], seed: int = 0) -> Curve:
    return Curve(ablation, seed, [100, 200, 300], [1.0, 2.0, 3.0], counts, 256, "a machine, 2 threads")


def test_quality_is_reached_at_the_first_validation_that_shows_it() -> None:
    assert curve("plus", [30, 4, 9]).reached() == 2.0
    assert curve("cgp", [30, 5, 9]).reached() is None
    found = quality.rows([curve("plus", [30, 4, 9]), curve("plus", [3, 0, 0], 1), curve("cgp", [80, 80, 80])], "quick")
    assert [(row.what, row.ratio) for row in found] == [("plus: the best together", 1.5), ("ConFlow (D+ and D-)", None)]
    assert "1 of 2 seeds" not in found[0].note
    assert "2 of 2 seeds" in found[0].note
    assert "80 of 256 at the end" in found[1].note
    (axis,) = quality.figure([curve("plus", [3, 0, 0]), replace(curve("cgp", [80, 80, 80]), hardware="another")]).axes
    assert len(axis.lines) == 3  # and that of the paper's rate
    assert axis.get_title() == "256 samples a validation; a machine, 2 threads and another"


def test_a_bench_survives_its_file_and_prints_in_every_form(elsewhere: Path) -> None:
    rows = [
        compared("a part", "ours", "theirs", [1.0, 1.0], [2.0, 4.0], "speed", Target(4, at_most=False)),
        alone("b", "c", [1]),
    ]
    said = {"hardware": "a machine", "threads": "2", "versions": "torch 2", "date": "today"}
    bench = Bench(said, rows, [scaling.Point("batch", 1, 1.0, 1.0)], [curve("plus", [1, 2, 3])])
    path = elsewhere / "runs" / "reference" / "bench.json"
    with pytest.raises(ConfigError, match=r"bench\.json: expected a bench, as a checkout .* has it, found none"):
        Bench.read(suite.REFERENCE)
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(asdict(bench)))
    assert Bench.read(path) == bench
    for form, expected in {
        "table": "missed, 0.75 times that",
        "markdown": "| ours | 1 s | theirs | 3 s | 3 times as fast [2.5, 3.5] | at least 4: missed, 0.75 times that |",
        "csv": "a part,ours,theirs,1.0,3.0,speed,3.0",
        "json": '"hardware": "a machine"',
    }.items():
        console = Console(width=200)
        with console.capture() as captured:
            table.render(bench, form, console)  # type: ignore[arg-type]  # one of its forms
        assert expected in captured.get()
    path.write_text("{}")
    with pytest.raises(ConfigError, match=r"bench\.json: expected a bench, found"):
        Bench.read(suite.REFERENCE)
