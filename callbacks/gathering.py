"""Samples of a test, gathered from all processes of a run."""

import torch
import torch.distributed
from torch import Tensor


def gather_samples(batches: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """What every process has kept of its batches, joined and in the order of `sample_id`.

    All processes have to call it. The order of the samples does not depend on how they were shared out.

    Args:
        batches: What this process kept, on the CPU: rows of samples, `sample_id` `(B,)` among them.

    Returns:
        The rows of all samples; nothing where no process kept any.
    """
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        kept: list[list[dict[str, Tensor]]] = [[] for _ in range(torch.distributed.get_world_size())]
        torch.distributed.all_gather_object(kept, batches)
        batches = [batch for part in kept for batch in part]
    if not batches:
        return {}
    joined = {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}
    order = joined["sample_id"].argsort(stable=True)
    return {name: value[order] for name, value in joined.items()}
