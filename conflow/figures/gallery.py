"""All pictures of finished runs, written under runs/figures/ and logged to the runs."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from mlflow.entities import Run
from rich.console import Console
from torch import Tensor

from conflow.errors import ConfigError
from conflow.figures import curves, workspace
from conflow.figures.animation import animation
from conflow.figures.front import front
from conflow.results import comparison
from conflow.results.records import LONGEST, Record
from conflow.scene.task import Task
from conflow.tracking import store
from conflow.training import diagnostics
from conflow.training.build import NONE, random_stream
from conflow.training.config import SPLITS, SplitName
from conflow.training.evaluation import Evaluation, cycle
from conflow.training.model import ConFlow, start_and_goal
from conflow.training.model_file import MODEL_FILE, load_model
from conflow.training.reload import demonstrations

NUM = 512
TIMES = (0.3, 0.6, 0.9)
"""At which `taken_back` is drawn."""
COMPARED = 0.6
"""The one of them at which several runs are compared."""


def draw(wanted: Sequence[str], split: SplitName, console: Console, task: Task | None = None) -> None:
    """Draw the pictures of each run, for starts and goals of a split; of several runs also a comparison of them.

    Those of the test split are in a folder `test` of their own, so that neither takes the place of the other.

    Raises:
        ConfigError: there is no such run.
    """
    runs = [store.find_run(name) for name in wanted]
    made = [(f"{_title(run)}, {SPLITS[split]} split", *_draw_run(run, split, console, task)) for run in runs]
    if len(made) > 1:
        console.print("all runs: methods.png, taken_back.png", highlight=False)
        methods = workspace.methods([(title, model, evaluation) for title, model, evaluation, _ in made])
        taken_back = curves.taken_back(
            [(_violations(title, model, evaluation), shares) for title, model, evaluation, shares in made]
        )
        taken_back.axes[0].set_title(f"what the velocity takes back by t = 1, at t = {COMPARED}")
        workspace.save({"methods": methods, "taken_back": taken_back}, _folder() / _subfolder(split))


def draw_front(console: Console) -> None:
    """Draw what fewer collisions cost, of the published runs as they are at their presets."""
    try:
        published = comparison.collect_reference()
    except ConfigError as error:
        console.print(f"front.png is left out; {error}", highlight=False, soft_wrap=True)
        return
    workspace.save({"front": front(published)}, _folder() / "explain")
    console.print("front.png: unguided collisions of the published runs, and what they cost", highlight=False)


def _title(run: Run) -> str:
    """A run's preset and name, and what sets it apart from its ablation, if that is known still."""
    one = Record.of(run)
    try:
        changes = one.changes
    except ConfigError:
        changes = []
    return " ".join([f"{one.preset}/{run.info.run_name}", *changes])


def _violations(title: str, model: ConFlow, evaluation: Evaluation) -> str:
    """The title, and how many of the trajectories without guidance violate what training keeps."""
    violates = model.trained.violation(evaluation.samples[NONE])
    return f"{title}: {int(violates.sum())} of {len(violates)} in violation"


def _folder() -> Path:
    return store.RUNS / "figures"


def _subfolder(split: SplitName) -> str:
    return "" if split == "val" else split


def _draw_run(run: Run, split: SplitName, console: Console, task: Task | None) -> tuple[ConFlow, Evaluation, Tensor]:
    """Write and log a run's pictures; its model, the samples that they show, and `taken_back` at t = 0.6."""
    model = load_model(store.artifact(run, MODEL_FILE), task=task)
    data = demonstrations(run, model)
    x_1 = cycle(data.held_out[split].x, NUM)
    name = str(run.info.run_name)
    # A name given in MLflow's pages may hold anything, also a way out of the folder.
    folder = _folder() / re.sub(r"[^\w.=-]+", "_", _title(run))[:LONGEST] / _subfolder(split)
    console.print(f"{name}: {NUM} trajectories under each setting, {SPLITS[split]} split", highlight=False)
    evaluation = sample(model, x_1)
    x_0, ends = evaluation.source_samples, start_and_goal(x_1)
    shares = {t: diagnostics.taken_back(model, x_0, x_1, t) for t in TIMES}
    along = (NONE, *model.task.settings())  # descent comes after the flow
    pictures: dict[str, Callable[[], Figure]] = {
        "demonstrations": lambda: workspace.demonstrations(data),
        "sources": lambda: workspace.sources(model, evaluation),
        "page": lambda: workspace.page(model, data, evaluation, split),
        "flow": lambda: workspace.flow(model, x_0, ends),
        "clearances": lambda: workspace.clearances(model, evaluation),
        "taken_back": lambda: curves.taken_back([(f"t = {t}", share) for t, share in shares.items()]),
        "guidance": lambda: curves.guidance({s: diagnostics.guidance(model, s, x_0, ends) for s in along}),
        "solver_steps": lambda: curves.solver_steps(model, x_0, ends),
        "guidance_weight": lambda: curves.guidance_weight(model, x_0, ends),
    }
    for title, picture in pictures.items():
        console.print(f"{name}: {title}.png", highlight=False)
        workspace.save({title: picture()}, folder)
    console.print(f"{name}: animation.html", highlight=False)
    page = folder / "animation.html"
    page.write_text(animation(model, evaluation, f"ConFlow, run {name}, {SPLITS[split]} split"), encoding="utf-8")
    # Training logged its own of these, of all its samples of the validation split.
    of_training = workspace.OF_TRAINING if split == "val" else ()
    _log(run, [page, *(folder / f"{title}.png" for title in pictures if title not in of_training)], split)
    console.print(f"{name}: pictures are in {folder}", highlight=False)
    return model, evaluation, shares[COMPARED]


def sample(model: ConFlow, x_1: Tensor) -> Evaluation:
    """Trajectories under every setting from the same x_0, with the starts and goals of x_1 (batch, T, D)."""
    x_0 = model.source.sample(model.source.observe(x_1), random_stream("figures", model.config.seed))
    return Evaluation(x_0, {setting: model.flow(x_0, setting, start_and_goal(x_1)) for setting in model.settings})


def _log(run: Run, files: Sequence[Path], split: SplitName) -> None:
    client = store.client()
    for file in files:
        client.log_artifact(run.info.run_id, str(file), str(Path("figures", _subfolder(split))))
