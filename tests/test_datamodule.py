import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from conflow.scene.constraint import Constraint, SpeedLimit
from conflow.scene.demonstrations import Demonstrations
from conflow.scene.errors import DemonstrationError
from conflow.scene.robots import Robots
from conflow.scene.task import Task
from conflow.scene.tasks.swap import swap
from conflow.training import config
from conflow.training.config import Config
from conflow.training.datamodule import Batches, DemonstrationData, Split
from conflow.training.model_file import load_model
from conflow.training.module import Training
from tests.papers import label


def rows(split: Split) -> set[bytes]:
    return {x.numpy().tobytes() for x in split.x}


def on_file(settings: Config, path: Path, **arrays: Any) -> Config:
    np.savez(path, allow_pickle=False, **arrays)
    return dataclasses.replace(settings, data=dataclasses.replace(settings.data, path=str(path)))


def test_the_splits_share_no_trajectory_and_lose_none(smoke: Config) -> None:
    data = DemonstrationData(smoke)
    train, val, test = rows(data.train), rows(data.val), rows(data.test)
    assert len(train | val | test) == len(train) + len(val) + len(test) == smoke.data.num


def test_the_split_depends_on_the_datas_seed_and_not_on_the_runs() -> None:
    one, same, other = (
        DemonstrationData(config.load(["preset=smoke", *arguments])).test.x
        for arguments in ((), ("seed=1",), ("data.seed=1",))
    )
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_labels_are_collisions_closer_than_the_radius(smoke: Config) -> None:
    data = DemonstrationData(smoke)
    distance = (data.x[:, :, :2] - data.x[:, :, 2:]).norm(dim=2).amin(dim=1)
    assert torch.equal(data.violates, distance < 0.3)


def test_without_negatives_training_and_validation_see_feasible_demonstrations_alone() -> None:
    mixed, feasible = (DemonstrationData(config.load(["preset=smoke", f"ablation={a}"])) for a in ("cgp", "fm"))
    assert mixed.train.violates.any()
    assert not feasible.train.violates.any()
    assert not feasible.val.violates.any()
    assert rows(feasible.train) == rows(mixed.train.feasible())
    # Every ablation answers the same test starts and goals.
    assert torch.equal(feasible.test.x, mixed.test.x)


@pytest.mark.parametrize("ablation", ["fm", "repair"])
def test_every_ablation_is_measured_on_the_same_starts_and_goals(ablation: str) -> None:
    """Also where validation of the loss sees D+ alone, or D- moved out of collision."""
    mixed, other = (DemonstrationData(config.load(["preset=smoke", f"ablation={a}"])) for a in ("cgp", ablation))
    for name in config.SPLITS:
        assert torch.equal(other.held_out[name].x, mixed.held_out[name].x)
        assert torch.equal(other.held_out[name].violates, mixed.held_out[name].violates)
        assert mixed.held_out[name].violates.any()
    assert rows(mixed.held_out["val"]) == rows(mixed.val)
    assert rows(other.held_out["val"]) != rows(other.val)


def test_batches_are_a_function_of_seed_and_step_and_resume_where_they_stopped(smoke: Config) -> None:
    split = DemonstrationData(smoke).train
    whole = [x for x, _ in Batches(split, 16, 6, seed=3)]
    stopped = Batches(split, 16, 6, seed=3)
    stream = iter(stopped)
    head = [next(stream)[0] for _ in range(4)]
    resumed = Batches(split, 16, 6, seed=3)
    resumed.load_state_dict(stopped.state_dict())
    tail = [x for x, _ in resumed]
    assert all(torch.equal(a, b) for a, b in zip(whole, head + tail, strict=True))
    assert not torch.equal(whole[0], next(iter(Batches(split, 16, 6, seed=4)))[0])


def test_batches_draw_trajectories_with_their_own_labels_and_reach_all_of_them(smoke: Config) -> None:
    split = DemonstrationData(smoke).train
    label = {x.numpy().tobytes(): bool(m) for x, m in zip(*split, strict=True)}
    seen = set()
    for x, violates in Batches(split, 400, 20, seed=0):
        seen |= {row.numpy().tobytes() for row in x}
        assert [label[row.numpy().tobytes()] for row in x] == violates.tolist()
    assert seen == set(label)  # a given one of 400 is missed by 8,000 draws with probability e^-20


def test_a_users_file_is_read_labelled_and_split(smoke: Config, tmp_path: Path) -> None:
    x = swap(200, T=20, seed=7).numpy()
    data = DemonstrationData(on_file(smoke, tmp_path / "mine.npz", x=x))
    assert np.array_equal(data.x.numpy(), x)
    assert (data.T, data.D) == (20, 4)
    assert 0 < data.violates.float().mean() < 1


def test_a_users_labels_are_kept(smoke: Config, tmp_path: Path) -> None:
    labels = np.arange(200) % 2 == 0
    data = DemonstrationData(on_file(smoke, tmp_path / "mine.npz", x=swap(200).numpy(), violates=labels))
    assert np.array_equal(data.violates.numpy(), labels)
    inverted = DemonstrationData(on_file(smoke, tmp_path / "other.npz", x=swap(200).numpy(), violates=~labels))
    assert inverted.digest != data.digest, "other labels are other demonstrations"


@pytest.mark.parametrize(("ablation", "violates", "said"), [("cgp", False, "needs D-"), ("fm", True, "no trajectory")])
def test_a_class_that_the_ablation_needs_and_the_file_lacks_is_named(
    ablation: str, violates: bool, said: str, tmp_path: Path
) -> None:
    settings = config.load(["preset=smoke", f"ablation={ablation}"])
    labels = np.full(100, violates)
    with pytest.raises(DemonstrationError, match=said) as refused:
        DemonstrationData(on_file(settings, tmp_path / "one.npz", x=swap(100).numpy(), violates=labels))
    assert "one.npz" in str(refused.value)


def test_a_trajectory_outside_the_workspace_is_refused_by_number(smoke: Config, tmp_path: Path) -> None:
    x = swap(50).numpy()
    x[17, 3, 1] = 1.5
    with pytest.raises(DemonstrationError, match=r"1 trajectories leave the workspace \[-1, 1\], the first is 17"):
        DemonstrationData(on_file(smoke, tmp_path / "far.npz", x=x))


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_a_batch_holds_the_share_of_negatives_that_is_asked_for(smoke: Config, share: float) -> None:
    split = DemonstrationData(smoke).train
    label = {x.numpy().tobytes(): bool(m) for x, m in zip(*split, strict=True)}
    for x, violates in Batches(split, 50, 5, seed=0, negative_share=share):
        assert violates.sum() == round(50 * share)
        assert [label[row.numpy().tobytes()] for row in x] == violates.tolist()


def test_repaired_demonstrations_are_all_feasible_and_feasible_ones_are_not_touched() -> None:
    mixed = DemonstrationData(config.load(["preset=smoke"]))
    repaired = DemonstrationData(config.load(["preset=smoke", "ablation=repair", "correction.margin=0.01"]))
    assert not repaired.train.violates.any()
    assert not repaired.val.violates.any()
    far = label(mixed.config).narrowed(0.01)
    feasible = ~far.violation(mixed.train.x)
    assert torch.equal(repaired.train.x[feasible], mixed.train.x[feasible])
    assert torch.equal(repaired.test.x, mixed.test.x)


def test_a_share_of_the_demonstrations_is_left_unrepaired() -> None:
    def train(*more: str) -> Split:
        return DemonstrationData(config.load(["preset=smoke", "ablation=repair", *more])).train

    raw, repaired, some = train("data.repair=false"), train(), train("data.unrepaired=0.3")
    left = round(0.3 * len(raw.x))
    assert torch.equal(some.x[:left], raw.x[:left])
    assert torch.equal(some.violates[:left], raw.violates[:left])
    assert torch.equal(some.x[left:], repaired.x[left:])
    assert not some.violates[left:].any()


def test_what_is_repaired_does_not_depend_on_the_source() -> None:
    """Or two sources would be compared on different demonstrations."""
    by_cgp, by_gaussian = (
        DemonstrationData(config.load(["preset=smoke", "ablation=repair", f"source.kind={kind}"]))
        for kind in ("cgp", "gaussian")
    )
    assert torch.equal(by_cgp.train.x, by_gaussian.train.x)


class Carts(Robots):
    D, radii, owner = 3, torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.long)

    def points(self, x: Tensor) -> Tensor:
        return x[:, :, None, :2]

    def pullback(self, x: Tensor, g: Tensor) -> Tensor:
        return F.pad(g[:, :, 0], (0, 1))


class Metres(Task):
    """A task of one's own: a cart on a plane with an arm, D = 3, as long as 4 s, in metres about the point (10, 20)."""

    T, seconds, scale, offset = 9, 4.0, 5.0, (10.0, 20.0, 0.0)

    def __init__(self) -> None:
        self.robots = Carts()

    def constraints(self) -> dict[str, Constraint]:
        return {"speed": SpeedLimit(self.robots, 0.2, self.dt)}

    def demonstrations(self, num: int, seed: int) -> Demonstrations:
        x = torch.zeros(num, self.T, 3)
        x[:, :, 0] = torch.linspace(-1, 1, self.T) * torch.linspace(0.1, 1, num)[:, None]
        return Demonstrations(x)


@pytest.mark.parametrize(
    ("said", "scale", "offset", "seconds"),
    [
        ({}, 5.0, [10.0, 20.0, 0.0], 4.0),
        ({"scale": 2.0}, 2.0, [10.0, 20.0, 0.0], 4.0),
        ({"offset": [1.0, 2.0]}, 5.0, [1.0, 2.0, 1.0], 4.0),
        ({"seconds": 8.0}, 5.0, [10.0, 20.0, 0.0], 8.0),
    ],
)
def test_units_and_seconds_are_the_tasks_where_the_file_says_nothing(
    said: dict[str, Any], scale: float, offset: list[float], seconds: float, smoke: Config, tmp_path: Path
) -> None:
    """And so are labels, of a limit to the speed: in twice the time a way may be twice as long."""
    x = Metres().demonstrations(200, 0).x
    settings = on_file(smoke, tmp_path / "cart.npz", x=x.numpy(), **said)
    data = DemonstrationData(settings, Metres())
    assert (data.task.scale, [*data.task.offset], data.task.seconds) == (scale, offset, seconds)  # type: ignore[misc]
    assert torch.equal(data.x, x)
    speed = 2 * x[:, -1, 0] / seconds
    assert torch.equal(data.violates, speed > 0.2)


def test_of_the_programs_own_tasks_a_files_units_hold_for_every_robot(smoke: Config, tmp_path: Path) -> None:
    data = DemonstrationData(on_file(smoke, tmp_path / "x.npz", x=swap(400).numpy(), scale=3.0, offset=[1.0, 2.0]))
    assert (data.task.scale, data.task.offset) == (3.0, [1.0, 2.0, 1.0, 2.0])
    plain = DemonstrationData(on_file(smoke, tmp_path / "y.npz", x=swap(400).numpy()))
    assert (plain.task.scale, plain.task.offset, plain.task.seconds) == (1.0, 0.0, 1.0)


@pytest.mark.parametrize("shape", [(200, 9, 4), (200, 8, 3), (200, 9, 2)])
def test_a_file_of_other_waypoints_or_numbers_than_the_tasks_is_refused(
    shape: tuple[int, ...], smoke: Config, tmp_path: Path
) -> None:
    settings = on_file(smoke, tmp_path / "cart.npz", x=np.zeros(shape, np.float32))
    said = rf"cart\.npz: x has shape \({shape[0]}, {shape[1]}, {shape[2]}\), expected \(N, 9, 3\), .* of task metres"
    with pytest.raises(DemonstrationError, match=said):
        DemonstrationData(settings, Metres())


def test_a_model_keeps_the_units_and_the_time_that_it_was_trained_with(tmp_path: Path) -> None:
    """Of a file, so that limits to the speed are the same again; the object that one brings stays as it was."""
    x = Metres().demonstrations(200, 0).x.numpy()
    settings = on_file(config.load(["preset=smoke", "task=metres.py"]), tmp_path / "cart.npz", x=x, scale=3, seconds=8)
    mine = Metres()
    before = dict(vars(mine))
    task = DemonstrationData(settings, mine).task
    trained = Training(settings, task)
    checkpoint: dict[str, Any] = {"state_dict": trained.state_dict()}
    trained.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, tmp_path / "model.ckpt")
    loaded = load_model(tmp_path / "model.ckpt", task=mine)
    assert (loaded.task.scale, loaded.task.seconds, loaded.task.dt) == (3.0, 8.0, 1.0)
    x_1 = torch.from_numpy(x)
    assert torch.equal(loaded.judged["speed"].clearance(x_1), trained.judged["speed"].clearance(x_1))
    assert vars(mine) == before
    assert (mine.scale, mine.seconds) == (5.0, 4.0)
    # A file from before that was kept has the task's own time.
    del checkpoint["conflow"]["seconds"]
    torch.save(checkpoint, tmp_path / "model.ckpt")
    assert load_model(tmp_path / "model.ckpt", task=mine).task.seconds == 4.0


def test_a_task_that_computes_its_units_and_its_time_is_loaded(tmp_path: Path) -> None:
    class Computed(Metres):
        seconds = property(lambda self: 2.0 * self.scale)
        scale = property(lambda self: 2.5)

    trained = Training(config.load(["preset=smoke", "task=computed.py"]), Computed())
    checkpoint: dict[str, Any] = {"state_dict": trained.state_dict()}
    trained.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, tmp_path / "model.ckpt")
    assert load_model(tmp_path / "model.ckpt", task=Computed()).task.seconds == 5.0


class Told(Metres):
    """The same cart, whose demonstrations come as somebody made them."""

    def __init__(self, **said: Any) -> None:
        super().__init__()
        self.said = said

    def demonstrations(self, num: int, seed: int) -> Demonstrations:
        return Demonstrations(**{"x": super().demonstrations(num, seed).x, **self.said})


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        (
            {"violates": torch.arange(200) % 2},
            r"violates holds int64 of shape \(200,\), expected bool of shape \(200,\)",
        ),
        (
            {"violates": (torch.arange(200) % 2).to(torch.uint8)},
            r"violates holds uint8 of shape \(200,\), expected bool",
        ),
        ({"violates": torch.ones(200)}, r"violates holds float32 of shape \(200,\), expected bool of shape \(200,\)"),
        (
            {"violates": torch.ones(199, dtype=torch.bool)},
            r"violates holds bool of shape \(199,\), expected bool of sh",
        ),
        ({"x": torch.zeros(200, 9, 3, dtype=torch.long)}, "x holds int64, expected floating-point numbers"),
        ({"x": None}, "x holds object, expected floating-point numbers"),
        ({"x": [[[0.0]], [[0.0, 0.0]]]}, "setting an array element with a sequence.*, expected arrays of numbers"),
        ({"scale": (1.0, 2.0)}, r"scale has shape \(2,\), expected \(\), finite numbers"),
        ({"seconds": 0}, "seconds=0.0: expected a number above 0"),
    ],
    ids=["int64", "uint8", "float", "too few", "whole numbers", "nothing", "ragged", "two scales", "no time"],
)
def test_what_a_task_demonstrates_is_checked_as_a_file_is(said: dict[str, Any], reason: str) -> None:
    """Labels of 0 and 1 would turn into D+ that is none: of whole numbers ~0 and ~1 are -1 and -2."""
    with pytest.raises(DemonstrationError, match=f"^demonstrations of task told: {reason}") as refused:
        DemonstrationData(config.load(["preset=smoke", "data.num=200"]), Told(**said))
    assert "\n" not in str(refused.value)


def test_a_task_may_demonstrate_with_numpy(smoke: Config) -> None:
    """In float64, and as a view that is read backwards."""
    x = Metres().demonstrations(smoke.data.num, 0).x
    labels = np.arange(len(x)) % 2 == 0
    data = DemonstrationData(smoke, Told(x=x.double().numpy()[::-1], violates=labels[::-1]))
    assert data.x.dtype == torch.float32
    assert torch.equal(data.x, x.flip(0))
    assert np.array_equal(data.violates.numpy(), labels[::-1])


def test_units_and_seconds_that_a_task_demonstrates_with_hold_as_a_files_do(smoke: Config) -> None:
    data = DemonstrationData(smoke, Told(scale=2, offset=np.array([1.0, 2.0]), seconds=8.0))
    assert (data.task.scale, data.task.offset, data.task.seconds) == (2.0, [1.0, 2.0, 1.0], 8.0)
    assert torch.equal(data.violates, 2 * data.x[:, -1, 0] / 8.0 > 0.2)
