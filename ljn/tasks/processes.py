"""The processes of one run: with `trainer.devices=2`, Lightning starts `run.py` again for the second device.

Each process reads the same command line and finds the same run directory; the first one alone writes to it.
`data.batch_size` counts the samples of a step over all processes, so that a run on several devices is the same
run, up to rounding, as on one.
"""

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from ljn.runs.processes import is_first_process, num_processes, process_number

if TYPE_CHECKING:
    from torch import nn


def is_job_of_sweep() -> bool:
    """Whether Hydra has started this run as a job of a multirun."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def sweep_name(hydra: Any) -> str:
    """What a multirun is called, by Hydra's part of its configuration; a free grid by the time of its start."""
    return hydra.runtime.choices.get("sweep") or f"grid-{Path(hydra.sweep.dir).name}"


def check_processes(plain: Mapping[str, Any]) -> None:
    """Raise a `ValueError` where a configuration, as plain values, cannot be run in the processes it asks for."""
    trainer, data = plain["trainer"], plain["data"]
    number = num_processes(trainer)
    if number == 1:
        if not is_first_process():
            raise ValueError(
                f"trainer.devices: this is process {process_number()} of several (RANK, LOCAL_RANK or SLURM_PROCID "
                "says so), but the run is for one device; start runs one by one, or as the jobs of a sweep with "
                "hydra/launcher=slurm, or unset the variable"
            )
        return
    if is_job_of_sweep():
        raise ValueError(
            f"trainer.devices: a job of a sweep uses one device, got {trainer['devices']!r}: the processes of a "
            "multi-device run read the command line again and would each start the whole sweep; use "
            "trainer.devices=1 and run several jobs at once (hydra/launcher=parallel, one job a device), or start the "
            "runs one by one without -m"
        )
    if trainer.get("strategy", "auto") not in ("auto", "ddp"):
        raise ValueError(
            f"trainer.strategy: expected auto or ddp with several devices, got '{trainer['strategy']}'; checkpoints "
            "and test errors are only gathered from these"
        )
    if data["batch_size"] % number:
        raise ValueError(
            f"data.batch_size: it counts the samples of a step over all {number} devices and must be a multiple of "
            f"{number}, got {data['batch_size']}"
        )
    smallest = {"num_train": data["batch_size"], "num_val": number, "num_test": number}
    for name, least in smallest.items():
        if data[name] < least:
            raise ValueError(
                f"data.{name}: expected at least {least} samples for {number} devices (a whole batch to train on, "
                f"one each to test), got {data[name]}; raise it, or use trainer.devices=1"
            )


def unclaimed_devices(trainer: Mapping[str, Any]) -> dict[str, list[int]]:
    """For a job of a sweep on a machine with several GPUs: `devices`, one that no other job uses; else nothing.

    Jobs that run in parallel would all take the first one.
    """
    import torch

    wants_one = trainer["devices"] in (1, "1") and trainer["accelerator"] in ("auto", "gpu", "cuda")
    if not (wants_one and is_job_of_sweep() and torch.cuda.device_count() > 1):
        return {}
    return {"devices": [claim_gpu(torch.cuda.device_count())]}


_claimed: dict[int, IO[str]] = {}


def claim_gpu(count: int, directory: Path | None = None) -> int:
    """The index of one of `count` visible GPUs that no other process has claimed; where all are taken, of any.

    A claim is a locked file in `directory` and ends with this process.
    """
    import fcntl

    if _claimed:
        return next(iter(_claimed))
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    directory = directory or Path(tempfile.gettempdir())
    for index in range(count):
        name = visible[index] if len(visible) == count else str(index)
        file = (directory / f"ljn-{os.getuid()}-gpu-{name}.lock").open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            continue
        _claimed[index] = file
        return index
    return os.getpid() % count


def check_trains_in_processes(module: "nn.Module", number: int) -> None:
    """Raise a `ValueError` where training in several processes would not give what one process gives."""
    from torch.nn.modules.batchnorm import _BatchNorm

    if number == 1:
        return
    if not any(parameter.requires_grad for parameter in module.parameters()):
        reason = "a yardstick is fitted in closed form, in seconds, by one process"
    elif any(isinstance(part, _BatchNorm) for part in module.modules()):
        reason = "the network normalises over the batch, which each process would do over its part alone"
    else:
        return
    raise ValueError(f"trainer.devices: {reason}; use trainer.devices=1, got {number} devices")
