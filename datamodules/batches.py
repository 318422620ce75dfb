"""Which samples make a batch, in one process or shared out among several, and how workers hand it over."""

import multiprocessing
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import BatchSampler, Sampler

BLOCK = 12
"""Batches that are made before any of them is used again."""


class EpochSampler(Sampler[tuple[int, int]]):
    """Pairs of the epoch's number and an index, in an order drawn anew for each epoch.

    The number travels with the index, so that workers that live on through epochs draw anew, too.

    Args:
        num_samples: Samples in an epoch.
        seed: Seed of the order.
        redraws: Whether the number beside an index is the epoch's; else it is 0 in every epoch.
        epoch: The first epoch that is asked for. Workers begin with it before the trainer calls `set_epoch`.
    """

    def __init__(self, num_samples: int, seed: int, redraws: bool = True, epoch: int = 0) -> None:
        self.num_samples = num_samples
        self.seed = seed
        self.redraws = redraws
        self.epoch = epoch

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


class RepeatedBatches(Sampler[list[Any]]):
    """Batches in blocks of `BLOCK`, each block `times` times over, with the number of the time added to the keys.

    As many batches as there were: only the first ones come, and the last block is cut off. Between two uses of a batch
    lie `BLOCK - 1` others, and one worker of 1, 2, 3, 4, 6 or 12 gets them all.
    """

    def __init__(self, batches: BatchSampler, times: int) -> None:
        self.batches = batches
        self.times = times

    @property
    def sampler(self) -> Any:
        """The samples' order, which the trainer tells the epoch."""
        return self.batches.sampler

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[list[Any]]:
        batches: Iterator[list[Any]] = iter(self.batches)
        left = len(self)
        while left:
            block = list(islice(batches, min(BLOCK, left)))
            for use in range(self.times):
                for batch in block[:left]:
                    yield [(*key, use) for key in batch]
                left -= min(len(block), left)


class SharedBatches(Sampler[list[Any]]):
    """One process's equal part of every batch, so that several processes take the steps that one would take."""

    def __init__(
        self, batches: BatchSampler | RepeatedBatches, process: int = 0, num_processes: int = 1
    ) -> None:
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
    `batch_size` counts the samples of the processes' batches together.
    """
    if num_processes == 1:
        return [list(range(start, min(start + batch_size, size))) for start in range(0, size, batch_size)]
    indices = np.array_split(np.arange(size), num_processes)[process]
    number = min(-(-size // batch_size), size // num_processes)
    return [part.tolist() for part in np.array_split(indices, number)]


class ByValue(dict[str, Tensor]):
    """A batch that goes to another process through a pipe, as bytes, and arrives there as a plain dict.

    PyTorch would hand tensors over in shared memory. Where `/dev/shm` is small (64 MB in a container), it fills up;
    the batch is lost and the training process waits for it without end.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return _received, ({name: value.numpy() for name, value in self.items()},)


def _received(arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    # Copied into PyTorch's own memory, since products may round by how their operands are aligned.
    return {name: torch.tensor(array) for name, array in arrays.items()}


def check_workers(num_workers: int) -> None:
    """Raise a `ValueError` unless the system has room for the queues of this many worker processes.

    A queue takes pipes and semaphores, and on Linux a semaphore takes a page of `/dev/shm`.
    """
    try:
        _ = [multiprocessing.Queue() for _ in range(num_workers + 3)]
    except OSError as error:
        raise ValueError(
            f"num_workers: the queues of {num_workers} workers cannot be made ({error.strerror}): too little room in "
            "/dev/shm, or too few open files allowed; use data.num_workers=0, give a container more with "
            "`docker run --shm-size=64m`, or raise `ulimit -n`"
        ) from error
