"""What there is beside training: source, correction, the ODE, a plan, demonstrations, and the command line's start."""

import subprocess
import sys
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn import Linear

from conflow.flow.sampler import Field, integrate
from conflow.flow.settings import Solver
from conflow.planner import Planner
from conflow.scene.tasks.swap import swap
from conflow.training import config
from conflow.training.build import fitted
from conflow.training.datamodule import DemonstrationData
from conflow.training.diagnostics import EVALUATIONS
from conflow.training.evaluation import LATENCY_BATCH, cycle
from conflow.training.model import ConFlow
from tests.bench import peers
from tests.bench.clock import Block, Pace, Row, Target, alone, alternate, beside, block
from tests.papers import label, model_of

SAMPLES = 2048
MILLION = 1_000_000
PLANS, LATENCIES = 64, 200
START, GOAL = (-0.8, 0.0, 0.8, 0.0), (0.8, 0.0, -0.8, 0.0)

GPYTORCH = Target(20, at_most=False)
BARE, BARE_TARGET = "the bare network as often", Target(1.05)
FEW = Target(10, at_most=False)
HELP = Target(0.5)
PRODUCTS, PRODUCTS_TARGET = "its layers' matrix products alone", Target(3)


def source(pace: Pace) -> list[Row]:
    """Samples of the conditional process beside those of libraries for Gaussian processes."""
    model, x = _model()
    y, s = model.source.observe(cycle(x, SAMPLES)), torch.linspace(0, 1, model.T)
    samplers = {name: make and make(s, y) for name, make in peers.processes().items()}
    part, what = f"{SAMPLES} samples of the CGP", "source"
    others = {name: sampler and block(sampler) for name, sampler in samplers.items()}
    return beside(part, what, block(lambda: model.source.sample(y)), others, pace, targets={"gpytorch": GPYTORCH})


def correction(pace: Pace) -> list[Row]:
    """The gradient and the correction in closed form beside autograd's."""
    model, x = _model()
    x, constraint = cycle(x, SAMPLES), label(model.config, model.D)

    def autograd() -> Tensor:
        leaf = x.clone().requires_grad_()
        return torch.autograd.grad(constraint.barrier(leaf).sum(), leaf)[0]

    part = f"the correction of {SAMPLES} trajectories"
    smoothed = block(lambda: (autograd().mT @ model.u_c.smoothing.mT).mT)
    return [
        *beside(part, "grad C", block(lambda: constraint.gradient(x)), {"autograd": block(autograd)}, pace),
        *beside(part, "u^c", block(lambda: model.u_c(x)), {"autograd and the filter": smoothed}, pace),
    ]


def ode(pace: Pace) -> list[Row]:
    """Sampling in the paper's 250 Euler steps, and in few."""
    paper, x = _model()
    sample, x_1 = paper.config.sample, cycle(x, LATENCY_BATCH)
    x_0, v = paper.source.sample(paper.source.observe(x_1)), paper.field("none")
    t = torch.zeros(len(x_0))

    @torch.no_grad()
    def bare() -> None:
        for _ in range(sample.steps):
            v(x_0, t)

    part, euler = f"{LATENCY_BATCH} trajectories, quick size", f"{sample.steps} Euler steps"
    others = {BARE: block(bare)} | _solved(v, x_0, sample.steps, sample.solver)
    found = beside(part, euler, block(lambda: paper.flow(x_0)), others, pace, "time", {BARE: BARE_TARGET})
    few, x = _model("plus")
    x_0, own = few.source.sample(few.source.observe(cycle(x, LATENCY_BATCH))), few.config.sample
    what, many = f"plus: {own.steps * EVALUATIONS[own.solver]} evaluations", f"the same network, {euler}"
    others = {many: block(lambda: integrate(few.field("none"), x_0, sample.steps, sample.solver))}
    return found + beside(part, what, block(lambda: few.flow(x_0)), others, pace, targets={many: FEW})


def plan(pace: Pace) -> list[Row]:
    """One request to the planner, with its guidance, beside other libraries' solvers on the same guided field."""
    model, _ = _model("plus")
    planner, sample = Planner(model), model.config.sample
    v, y = model.field("robot"), torch.tensor([START, GOAL]).expand(PLANS, 2, model.D)
    solved = _solved(v, model.source.sample(y), sample.steps, sample.solver)
    run = block(partial(planner.plan, START, GOAL, PLANS))
    others = {PRODUCTS: _products(model)} | solved
    p50, p99 = (1000 * one for one in np.quantile([run(1) for _ in range(LATENCIES)], [0.5, 0.99]))
    note = f"p50 {p50:.1f} ms, p99 {p99:.1f} ms of {LATENCIES}"
    return beside(
        f"one plan of {PLANS} by plus", "planner.plan", run, others, pace, "time", {PRODUCTS: PRODUCTS_TARGET}, note
    )


def _products(model: ConFlow) -> Block:
    """The matrix products of the network's layers for PLANS trajectories, as often as a plan evaluates them."""
    layers = [
        (torch.randn(PLANS, one.in_features), one.weight.T) for one in model.v.modules() if isinstance(one, Linear)
    ]
    sample = model.config.sample

    def products() -> None:
        for _ in range(sample.steps * EVALUATIONS[sample.solver]):
            for h, W in layers:
                h @ W

    return block(products)


def demonstrations() -> list[Row]:
    """Generating and labelling a million."""
    settings = config.load()
    constraint = label(settings, 4)
    seconds = [block(lambda: constraint.violation(swap(MILLION)))(1) for _ in range(3)]
    return [alone("demonstrations", "generating and labelling a million", seconds)]


def start(pace: Pace) -> list[Row]:
    """How long the command line takes to say something."""

    def command(*arguments: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *arguments], check=False, capture_output=True)

    commands = {"help": command("-m", "conflow", "--help"), "typo": command("-m", "conflow", "train", "trian.lr=1")}
    seconds = alternate({name: block(one) for name, one in commands.items()}, Pace(pace.rounds, 0))
    return [
        alone("start", "conflow --help", seconds["help"], HELP),
        alone("start", "a mistyped setting is answered", seconds["typo"]),
    ]


def _model(ablation: str = "cgp") -> tuple[ConFlow, Tensor]:
    """An untrained model of an ablation at `quick`, ready to sample, and the demonstrations for it."""
    settings = config.load(["preset=quick", f"ablation={ablation}"])
    data = DemonstrationData(settings)
    feasible = data.train.feasible().x
    model = model_of(fitted(settings, feasible), data.T, data.D).eval()
    model.fit(feasible)
    return model.requires_grad_(False), data.x


def _solved(v: Field, x_0: Tensor, steps: int, solver: Solver) -> dict[str, Block | None]:
    """Each peer's solution of the same ODE, None where it is absent."""
    return {name: solve and block(partial(solve, v, x_0, steps, solver)) for name, solve in peers.solvers().items()}
