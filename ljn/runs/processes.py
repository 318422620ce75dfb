"""The processes of one run, of which the first one alone writes."""

import os
from collections.abc import Mapping
from typing import Any


def process_number() -> int:
    """This process's number among those of its run, from what started it (Lightning, torchrun or SLURM); 0 if alone."""
    for name in ("RANK", "LOCAL_RANK", "SLURM_PROCID"):  # as Lightning looks for it
        if name in os.environ:
            return int(os.environ[name])
    return 0


def is_first_process() -> bool:
    """Whether this process is the one of its run that writes records, files and tables."""
    return process_number() == 0


def num_processes(trainer: Mapping[str, Any]) -> int:
    """How many processes a trainer's configuration asks for: one a device.

    Raises:
        ValueError: It does not say how many.
    """
    devices = trainer.get("devices", 1)
    if isinstance(devices, str) and devices.isdigit():
        devices = int(devices)
    if isinstance(devices, int) and not isinstance(devices, bool) and devices >= 1:
        return devices
    if not isinstance(devices, str) and hasattr(devices, "__len__") and len(devices) >= 1:
        return len(devices)
    raise ValueError(
        f"trainer.devices: expected a number of devices of 1 or more, or a list of their indices, got {devices!r}; "
        "say how many: trainer.devices=2"
    )
