"""Tables of results."""

from rich.table import Table

from conflow.experiment.evaluation import Metrics
from conflow.experiment.module import Setting

ROWS = {
    "robot_collision_rate": "robot-collision rate",
    "object_collision_rate": "object-collision rate",
    "success_rate": "success rate",
    "outside_rate": "rate of leaving the workspace",
    "energy_distance": "energy distance to held-out D+",
    "smoothness_median": "smoothness, median",
    "smoothness_p95": "smoothness, 95th percentile",
    "path_length_median": "path length per robot, median",
    "start_error": "start error per robot",
    "end_error": "end error per robot",
    "diversity": "diversity",
}


def results_table(results: dict[Setting, Metrics], title: str) -> Table:
    """The test metrics of one run, a column for each setting, each with its 95 % interval."""
    num = int(next(iter(results.values()))["num"])
    table = Table(title=title, caption=f"{num} trajectories a setting; in brackets 95 % intervals")
    table.add_column("metric")
    for setting in results:
        table.add_column(setting, justify="right")
    for key, label in ROWS.items():
        table.add_row(label, *(_estimate(metrics, key) for metrics in results.values()))
    table.add_row("ms for a batch of 256", *(f"{metrics['latency_ms']:.0f}" for metrics in results.values()))
    return table


def _estimate(metrics: Metrics, key: str) -> str:
    """The value over its interval; nothing where the metric was left out."""
    if key not in metrics:
        return ""
    stem = key.removesuffix("_rate")
    return f"{metrics[key]:.4f}\n[dim]\\[{metrics[f'{stem}_low']:.4f}, {metrics[f'{stem}_high']:.4f}][/dim]"
