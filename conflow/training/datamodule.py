"""Demonstrations for training and evaluation: generated or read, labelled, split, and served in whole batches."""

import hashlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, TensorDataset

from conflow.scene import demonstrations
from conflow.scene.demonstrations import Demonstrations
from conflow.scene.errors import DemonstrationError
from conflow.scene.task import Task, demonstrated, told
from conflow.training.build import build_task, labels, random_stream, repaired
from conflow.training.config import Config, SplitName
from conflow.training.memory import check_memory


class Split(NamedTuple):
    """Trajectories x_1 (N, T, D) and whether they violate the constraint, M (N,)."""

    x: Tensor
    violates: Tensor

    def feasible(self) -> "Split":
        """D+ alone."""
        return Split(self.x[~self.violates], self.violates[~self.violates])


class Batches:
    """x_1 ~ q(x_1): `steps` whole batches drawn by index from memory, each a function of (seed, step) alone.

    Iteration starts after `step` batches, which `state_dict` remembers.

    Args:
        negative_share: of D- in each batch; None, or one of both alone, draws from all alike.
        others: demonstrations of fewer robots, seen in turn with these, as many more at a time as they are smaller.
    """

    def __init__(
        self,
        split: Split,
        batch_size: int,
        steps: int,
        seed: int,
        negative_share: float | None = None,
        others: Sequence[Split] = (),
    ) -> None:
        self.splits, self.steps, self.seed = (split, *others), steps, seed
        D = split.x.shape[2]
        self.parts = [
            _parts(one.violates, round(batch_size * D / one.x.shape[2]), negative_share) for one in self.splits
        ]
        self.step = 0

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        for step in range(self.step, self.steps):
            turn = step % len(self.splits)
            (x, violates), parts = self.splits[turn], self.parts[turn]
            # Drawn where the data are: a copy from the host at every step would make an accelerator wait.
            noise = random_stream("batch", self.seed, step, device=x.device)
            i = torch.cat(
                [part[torch.randint(len(part), (count,), generator=noise, device=x.device)] for part, count in parts]
            )
            self.step = step + 1
            yield x.index_select(0, i), violates[i]  # whole trajectories at a time, which x[i] does not

    @property
    def sizes(self) -> list[int]:
        """How many trajectories the batches have that are seen in turn."""
        return [sum(count for _, count in parts) for parts in self.parts]

    def state_dict(self) -> dict[str, int]:
        return {"step": self.step}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.step = state["step"]


def _parts(violates: Tensor, batch_size: int, negative_share: float | None) -> list[tuple[Tensor, int]]:
    """Which trajectories a batch is drawn from, and how many from each."""
    parts = [(torch.ones_like(violates), batch_size)]
    if negative_share is not None and 0 < int(violates.sum()) < len(violates):
        negatives = round(negative_share * batch_size)
        parts = [(violates, negatives), (~violates, batch_size - negatives)]
    return [(chosen.nonzero()[:, 0], count) for chosen, count in parts if count]


class DemonstrationData(LightningDataModule):
    """The demonstrations of one experiment.

    `train` and `val` hold D+ and D-, or D+ alone where `data.negatives` is false. `test` always holds both: its
    trajectories only lend their starts and goals to the samples, so every ablation is asked the same questions.
    `train` keeps no trajectory of `val` or `test`.

    Args:
        config: the experiment.
        task: what they are for; by default what the config names.
        training: whether a model is to be trained on them. To sample one again, or to know them again, takes neither
            repair nor all classes: there is no `train`, `val` and `others` then.

    Attributes:
        held_out: what models are measured on, D+ and D- as they were demonstrated: `test`, and all of the validation
            split, of which `val` is what val/loss is taken on.
        origin: where the demonstrations are from, as messages say it.
        task: what they are for.
        others: of the task's other `variants`, for training alone.
        x, violates: all demonstrations and their labels M.
        digest: fingerprint of what was demonstrated, and of the labels that came with it; others follow from that and
            the config.

    Raises:
        DemonstrationError: the demonstrations cannot be used, or a class that the ablation needs is missing.
        ConfigError: so many demonstrations or samples do not fit into this machine's memory.
    """

    def __init__(self, config: Config, task: Task | None = None, training: bool = True) -> None:
        super().__init__()
        self.config = config
        self.origin, found, self.task = self._demonstrations(task)
        x, violates = found.x, found.violates
        self.x = x
        self.T, self.D = x.shape[1:]
        # x_1, and of either split x_0 and what each of the settings makes of it; the metrics join one, and double its
        # precision.
        pieces = 2 * (len(self.task.settings()) + 1) + 6
        check_memory("sample.num", config.sample.num, pieces * 4 * config.sample.num * self.T * self.D)
        self.violates = labels(config, self.task).violation(x) if violates is None else violates
        self.digest = demonstrations.digest(x, violates)
        whole, val, self.test = self._split()
        self.held_out: dict[SplitName, Split] = {"val": val, "test": self.test}
        variants = self.task.variants()[:-1] if config.data.path is None else []
        others = [(task, demonstrated(task, config.data.num, config.data.seed).x) for task in variants]
        if training:
            self.train, self.val = self._shown(whole, val)
            shown = [self._of_variant(x, task) for task, x in others]
            self.others = [split for split in shown if len(split.x)]
        self._check_left("test", len(self.test.x), 2)  # of a single one there is no diversity
        if others:
            # Before repair: that follows from the source, which of a trained model is fitted.
            every = [self.digest, *(demonstrations.digest(x, None) for _, x in others)]
            self.digest = hashlib.sha256(" ".join(every).encode()).hexdigest()[: len(self.digest)]

    @property
    def known(self) -> Tensor:
        """What a source and a network are fitted to: D+ of the training, or all where there is none, (N, T, D)."""
        feasible = self.train.feasible().x
        return feasible if len(feasible) else self.train.x

    def _demonstrations(self, task: Task | None) -> tuple[str, Demonstrations, Task]:
        """Where they are from, what they are, and the task they are for."""
        data = self.config.data
        if data.path is not None:
            origin, found = f"data.path={data.path}", demonstrations.load(data.path)
            demonstrations.check(found.x, origin)
            task = task or self._task_of(found.x, origin)
        else:
            task = task or build_task(self.config)
            # The whole once more in the splits, and twice while it is generated.
            check_memory("data.num", data.num, 4 * 4 * data.num * task.T * task.robots.D)
            origin, found = f"demonstrations of task {task.name}", demonstrated(task, data.num, data.seed)
            demonstrations.check(found.x, origin)
        if found.x.shape[1:] != (task.T, task.robots.D):
            raise DemonstrationError(
                f"{origin}: x has shape {tuple(found.x.shape)}, expected (N, {task.T}, {task.robots.D}), the waypoints "
                f"and the numbers of task {task.name}"
            )
        return origin, found, told(task, found.scale, found.offset, found.seconds)

    def _task_of(self, x: Tensor, origin: str) -> Task:
        """The task that the config names, for trajectories x (N, T, D) of a file."""
        try:
            return build_task(self.config, *x.shape[1:])
        except DemonstrationError as error:
            raise DemonstrationError(f"{origin}: {error}") from None

    def _split(self) -> list[Split]:
        """For training, validation and test, as they were demonstrated."""
        data = self.config.data
        order = torch.randperm(len(self.x), generator=random_stream("split", data.seed))
        val, test = round(data.val_fraction * len(order)), round(data.test_fraction * len(order))
        parts = torch.split(order, [len(order) - val - test, val, test])
        return [Split(self.x[i], self.violates[i]) for i in parts]

    def _shown(self, train_split: Split, val_split: Split) -> tuple[Split, Split]:
        """What training sees of its own split and of that of validation."""
        data = self.config.data
        needs = f"and ablation {self.config.ablation} needs"
        if data.negatives and not bool(train_split.violates.any()):
            raise DemonstrationError(f"{self.origin}: no trajectory for training violates the constraint, {needs} D-")
        if data.repair:
            train_split, val_split = (self._repaired(one, self.task) for one in (train_split, val_split))
        # A correction at the predicted end says itself what is feasible; any other method has to be shown it.
        shown = not data.negatives or self.config.correction.at != "end"
        if shown and len(train_split.x) and bool(train_split.violates.all()):
            raise DemonstrationError(
                f"{self.origin}: no trajectory for training is feasible out of {len(train_split.x)}, {needs} D+"
            )
        if not data.negatives:
            train_split, val_split = train_split.feasible(), val_split.feasible()
        self._check_left("training", len(train_split.x), 1)
        self._check_left("validation", len(val_split.x), 1)
        return train_split, val_split

    def _check_left(self, part: str, left: int, needed: int) -> None:
        if left < needed:
            said = f"{left} trajectories are left for {part} out of {len(self.x)}"
            raise DemonstrationError(f"{self.origin}: {said}, expected {needed} or more")

    def _of_variant(self, x: Tensor, task: Task) -> Split:
        """What training sees of the demonstrations of another of the task's variants."""
        split = self._labelled(x, task)
        split = self._repaired(split, task) if self.config.data.repair else split
        return split if self.config.data.negatives else split.feasible()

    def _repaired(self, split: Split, task: Task) -> Split:
        """The trajectories of a split, but for a share `data.unrepaired`, out of collision, with new labels."""
        left, moved = split.x.tensor_split([round(self.config.data.unrepaired * len(split.x))])
        return self._labelled(torch.cat([left, repaired(self.config, task, moved)]), task)

    def _labelled(self, x: Tensor, task: Task) -> Split:
        return Split(x, labels(self.config, task).violation(x))

    def train_dataloader(self) -> Batches:
        train = self.config.train
        # The data move to the accelerator once, not batch by batch.
        device = self.trainer.strategy.root_device if self.trainer else torch.device("cpu")
        split, *others = (Split(one.x.to(device), one.violates.to(device)) for one in (self.train, *self.others))
        share = self.config.data.negative_share
        return Batches(split, train.batch_size, train.max_steps, self.config.seed, share, others)

    def val_dataloader(self) -> DataLoader[tuple[Tensor, ...]]:
        """The whole of `val` as one batch."""
        return DataLoader(TensorDataset(*self.val), batch_size=None, sampler=[slice(None)])
