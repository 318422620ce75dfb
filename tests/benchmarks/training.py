"""What a training step costs, and what of it is data, network and body layer: python -m tests.benchmarks.training

One thread, processor time, medians over steps, with `preset=small` as configured, a row for each experiment. `data` is
the making of a sample, which a worker process does beside the training; `body` is the body layer with the loss on its
vertices, forward and backward; `network` is the rest of the step, the optimizer apart.
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from hydra import compose, initialize_config_dir

from ljn.building import build
from ljn.tasks import schema

EXPERIMENTS = (
    "detector/basic", "detector/proposed", "detector/simple_baseline", "detector/cascade", "mesh/basic",
    "mesh/proposed", "mesh/pointnet", "mesh/kinematic",
)  # fmt: skip
STEPS = 12


class Clock:
    """Adds the processor time since the mark before, milliseconds a sample, to the lists in `found`."""

    def __init__(self, found: dict[str, list[float]], size: int) -> None:
        self.found, self.size, self.last = found, size, time.process_time()

    def mark(self, name: str | None = None) -> None:
        """The end of a part; without a name, of one that does not count."""
        now = time.process_time()
        if name is not None:
            self.found.setdefault(name, []).append(1000 * (now - self.last) / self.size)
        self.last = now


def time_experiment(experiment: str, directory: str) -> dict[str, float]:
    """Milliseconds a sample of each part."""
    conf = str(Path(__file__).parents[2] / "conf")
    schema.register()
    with initialize_config_dir(conf, version_base="1.3"):
        overrides = [
            "preset=small",
            "preset.num_train=2000",
            "data.num_workers=0",
            f"paths.output_dir={directory}",
        ]
        cfg = compose("config", [f"experiment={experiment}", *overrides])
    datamodule, module = build(cfg.data), build(cfg.module)
    datamodule.takes = module.takes
    datamodule.prepare_data()
    datamodule._train = datamodule._synthesizer("train")  # without the fixed sets
    optimizer: Any = module.configure_optimizers()
    optimizer = optimizer["optimizer"] if isinstance(optimizer, dict) else optimizer
    found: dict[str, list[float]] = {}
    batches = iter(datamodule.train_dataloader())
    size = cfg.data.batch_size
    for _ in range(STEPS):
        clock = Clock(found, size)
        batch = next(batches)
        clock.mark("data")
        module.loss(batch).backward()
        clock.mark("forward and backward")
        optimizer.step()
        optimizer.zero_grad()
        clock.mark("optimizer")
        if hasattr(module, "body"):
            # The same loss of an estimate that no network made.
            estimate = [value.detach().requires_grad_() for value in module(batch)]
            with mock.patch.object(module, "forward", return_value=estimate):
                clock.mark()
                module.loss(batch).backward()
                clock.mark("body")
    medians = {name: statistics.median(values[2:]) for name, values in found.items()}
    body = medians.get("body", 0.0)
    step = medians["forward and backward"] + medians["optimizer"]
    return {
        "data": medians["data"],
        "network": medians["forward and backward"] - body,
        "body": body,
        "optimizer": medians["optimizer"],
        "step": step,
        "steps' samples/s": 1000 / step,
    }


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    header = ("data", "network", "body", "optimizer", "step", "steps' samples/s")
    print(f"{'ms/sample':28s}" + "".join(f"{name:>18s}" for name in header))
    with tempfile.TemporaryDirectory() as directory:
        for experiment in sys.argv[1:] or EXPERIMENTS:
            row = time_experiment(experiment, directory)
            print(f"{experiment:28s}" + "".join(f"{row[name]:18.2f}" for name in header), flush=True)


if __name__ == "__main__":
    main()
