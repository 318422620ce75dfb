"""The processes of one run (only the first one writes files), and how a signal ends them."""

import math
import os
import signal
import threading
import time
from collections.abc import Mapping
from typing import Any

_APART_S = 2.0


class Interruption(SystemExit):
    """SIGTERM (`docker stop`, SLURM, `kill`) or Ctrl-C: ends the process with the code 128 + the signal's number.

    Attributes:
        name: `SIGTERM` or `SIGINT`.
    """

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.name = signal.Signals(number).name


def end_on_signals() -> None:
    """Let SIGTERM and Ctrl-C raise `Interruption`, so that records and tables are written before the process ends.

    Without this, SIGTERM ends Python at once, and Lightning turns it into a success. A signal that follows closely
    upon another (many tools send both a group and its first process one) does nothing. A handler that somebody else
    has set (a launcher's, say) stays.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    last = -math.inf

    def end(number: int, frame: Any) -> None:
        nonlocal last
        before, last = last, time.monotonic()
        if last - before > _APART_S:
            raise Interruption(number)

    for number, default in ((signal.SIGTERM, signal.SIG_DFL), (signal.SIGINT, signal.default_int_handler)):
        if signal.getsignal(number) == default:
            signal.signal(number, end)


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
    """How many processes a trainer's configuration asks for: one a device; a `ValueError` where it does not say."""
    devices = trainer.get("devices", 1)
    number = devices
    if isinstance(devices, str):
        number = int(devices) if devices.isdigit() else devices
    elif hasattr(devices, "__len__"):
        number = len(devices)
    if type(number) is int and number >= 1:
        return number
    raise ValueError(
        f"trainer.devices: expected a number of devices of 1 or more, or a list of their indices, got {devices!r}; "
        "say how many: trainer.devices=2"
    )
