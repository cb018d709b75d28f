"""The results of one run, as a table for the terminal."""

from rich.table import Table

from conflow.training.evaluation import Evaluation, Metrics, latency_batch

ROWS = {
    "success_rate": "success rate",
    "outside_rate": "rate of leaving the workspace",
    "collision_intensity": "share of waypoints in violation",
    "energy_distance": "energy distance to held-out D+",
    "smoothness_median": "smoothness, median",
    "smoothness_p95": "smoothness, 95th percentile",
    "path_length_median": "path length per robot, median",
    "start_error": "start error per robot",
    "end_error": "end error per robot",
    "diversity": "diversity",
}
OF_ARMS = {
    "joint_smoothness_median": "smoothness of joints, median",
    "joint_path_length_median": "path length of joints, median",
    "hand_path_length_median": "path length per hand, median",
}


def results_table(evaluation: Evaluation, title: str) -> Table:
    """The metrics of one run on a split, a column for each setting, each with its 95 % interval."""
    results, batch = evaluation.results, latency_batch(evaluation.source_samples.shape[2])
    num = int(next(iter(results.values()))["num"])
    made = Table(title=title, caption=f"{num} trajectories a setting; in brackets 95 % intervals")
    made.add_column("metric")
    for setting in results:
        made.add_column(setting, justify="right")
    of_first = next(iter(results.values()))
    of_arms = {key: label for key, label in OF_ARMS.items() if key in of_first}
    for key, label in (_collisions(of_first) | ROWS | of_arms).items():
        made.add_row(label, *(_result(metrics, key) for metrics in results.values()))
    made.add_row(f"ms for a batch of {batch}", *(f"{metrics['latency_ms']:.0f}" for metrics in results.values()))
    return made


def _collisions(metrics: Metrics) -> dict[str, str]:
    """The rows of the constraints, by their metrics."""
    names = [key.removesuffix("_collision_rate") for key in metrics if key.endswith("_collision_rate")]
    return {f"{name}_collision_rate": f"{name}-collision rate" for name in names}


def _result(metrics: Metrics, key: str) -> str:
    """The value over its interval; nothing where the metric was left out."""
    if key not in metrics:
        return ""
    low, high = (metrics[f"{key.removesuffix('_rate')}_{end}"] for end in ("low", "high"))
    return f"{digits(metrics[key])}\n[dim]\\[{digits(low)}, {digits(high)}][/dim]"


def digits(value: float) -> str:
    """Four decimals; of what would lose its digits so, two of them."""
    return f"{value:.2g}" if 0 < abs(value) < 1e-3 else f"{value:.4f}"
