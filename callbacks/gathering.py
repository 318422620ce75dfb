"""Samples of a test, gathered from all processes of a run."""

import torch
import torch.distributed
from torch import Tensor


def gather_samples(batches: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """The rows of all processes' batches, on the CPU, joined and in the order of `sample_id` `(B,)`, one of them.

    All processes have to call it. The order of the samples does not depend on how they were shared out. Nothing comes
    back where no process has any.
    """
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        parts: list[list[dict[str, Tensor]]] = [[] for _ in range(torch.distributed.get_world_size())]
        torch.distributed.all_gather_object(parts, batches)
        batches = [batch for part in parts for batch in part]
    if not batches:
        return {}
    joined = join_batches(batches)
    order = joined["sample_id"].argsort(stable=True)
    return {name: value[order] for name, value in joined.items()}


def join_batches(batches: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """The rows of one batch or more."""
    return {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}
