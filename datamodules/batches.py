"""Which samples make a batch, in one process or shared out among several."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch.utils.data import BatchSampler, Sampler


class EpochSampler(Sampler[tuple[int, int]]):
    """Indices in an order drawn anew for each epoch, each with the epoch's number beside it.

    The number travels with the index, so that workers that live on through epochs draw anew without being told.
    """

    def __init__(self, num_samples: int, seed: int, redraws: bool = True) -> None:
        self.num_samples = num_samples
        self.seed = seed
        self.redraws = redraws
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Called by the trainer before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.num_samples

    def __iter__(self) -> Iterator[tuple[int, int]]:
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.epoch)
        epoch = self.epoch if self.redraws else 0
        for index in torch.randperm(self.num_samples, generator=generator).tolist():
            yield epoch, index


class SharedBatches(Sampler[list[Any]]):
    """One process's equal part of every batch, so that several processes take the steps that one would take.

    Args:
        batches: The whole batches.
        process: This process's number.
        num_processes: How many there are.
    """

    def __init__(self, batches: BatchSampler, process: int = 0, num_processes: int = 1) -> None:
        self.batches = batches
        self.process = process
        self.num_processes = num_processes

    @property
    def sampler(self) -> Any:
        """The samples' order, which the trainer tells the epoch."""
        return self.batches.sampler

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[list[Any]]:
        for batch in self.batches:
            yield batch[self.process :: self.num_processes]


def fixed_batches(size: int, batch_size: int, process: int = 0, num_processes: int = 1) -> list[list[int]]:
    """A process's batches of the indices of a fixed set: each index in one process only, and in one batch.

    All processes have the same number of batches and none is empty, since each may wait for the others in each.

    Args:
        size: Samples in the set, at least `num_processes`.
        batch_size: Samples in the processes' batches together.
        process: This process's number.
        num_processes: How many there are.
    """
    if num_processes == 1:
        return [list(range(start, min(start + batch_size, size))) for start in range(0, size, batch_size)]
    own = np.array_split(np.arange(size), num_processes)[process]
    number = min(-(-size // batch_size), size // num_processes)
    return [part.tolist() for part in np.array_split(own, number)]
