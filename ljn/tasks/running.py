"""What tasks that fit or test a model have in common: its directory, its process, its trainer, its metrics."""

import logging
import math
import os
import warnings
from pathlib import Path
from typing import Any

import lightning.pytorch as lightning
import torch
from omegaconf import DictConfig, OmegaConf, open_dict

from ljn.building import build, build_each
from ljn.data import DataModule
from ljn.modules.base import StageModule
from ljn.runs import layout
from ljn.runs.checkpoints import AtomicCheckpointIO, Provenance
from ljn.runs.files import path_part, write_text_atomically
from ljn.runs.processes import is_first_process, num_processes
from ljn.runs.random_state import RandomState
from ljn.tasks.processes import unclaimed_devices

# What Lightning says of things that are as they should be.
_EXPECTED_WARNINGS = (
    ".*LeafSpec.* is deprecated",  # its own use of PyTorch
    ".*this fit will run with no optimizer",  # a yardstick
    "Checkpoint directory .* exists and is not empty",  # a resumed run
    "The number of training batches .* is smaller than the logging interval",
    "It is recommended to use .*sync_dist=True",  # metrics gather themselves over processes
)


def set_run_directory(cfg: DictConfig, kind: str, identity_hash: str) -> Path:
    """Name the directory `output_dir/kind/NAME-PRESET-HASH` and make it `paths.run_dir`."""
    name = f"{path_part(cfg.name)}-{path_part(cfg.preset.name)}-{identity_hash}"
    run_dir = Path(cfg.paths.output_dir) / kind / name
    with open_dict(cfg):
        cfg.paths.run_dir = str(run_dir)
    return run_dir


def prepare_process(cfg: DictConfig) -> None:
    """Seed the global generators, share the cores between PyTorch and the data workers, quieten Lightning."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in _EXPECTED_WARNINGS:
        warnings.filterwarnings("ignore", message)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    number = num_processes(cfg.trainer)
    num_threads = use_threads(cfg, number)
    if number > 1:
        # Where this is not set, Lightning gives each of several processes its share of all cores.
        os.environ.setdefault("OMP_NUM_THREADS", str(num_threads))


def use_threads(cfg: DictConfig, num_processes: int = 1) -> int:
    """Let PyTorch use as many threads as `num_threads` says; returns their number.

    Null: half of the process's cores. With a thread on every core, each parallel region waits for the one that shares
    its core with something else: a data worker, or what else a prediction does.
    """
    num_threads: int = cfg.num_threads or max(1, _num_cores() // (2 * num_processes))
    torch.set_num_threads(num_threads)
    return num_threads


def _num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def build_trainer(
    cfg: DictConfig, run_dir: Path, config: dict[str, Any], datamodule: DataModule, module: StageModule
) -> lightning.Trainer:
    """The trainer with its callbacks and loggers, writing below the run's directory."""
    body_hashes = {body.hash for body in datamodule.bodies} | set(module.body_hashes)
    detector = datamodule.detector_file
    provenance = Provenance(
        *(config, "-".join(sorted(body_hashes)), datamodule.licence, run_dir.name, datamodule.recipe),
        None if detector is None else detector.read_bytes(),
    )
    return build(
        cfg.trainer,
        default_root_dir=str(run_dir),
        callbacks=[*build_each(cfg.callbacks), provenance, RandomState()],
        logger=build_each(cfg.logger),
        plugins=[AtomicCheckpointIO()],
        use_distributed_sampler=False,  # the data module gives each process its part, and none twice
        **unclaimed_devices(cfg.trainer),
    )


def finite_metrics(trainer: lightning.Trainer) -> dict[str, float]:
    """The metrics of the trainer's last validation or test; a `FloatingPointError` where one is not finite."""
    metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
    if bad := [name for name, value in metrics.items() if not math.isfinite(value)]:
        raise FloatingPointError(
            f"{', '.join(bad)} not finite: the model predicts NaN or infinity; lower the learning rate"
        )
    return metrics


def save_config(cfg: DictConfig, run_dir: Path) -> dict[str, Any]:
    """Write `config.yaml`, resolved, in the first process; returns the same as plain values."""
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    if is_first_process():
        write_text_atomically(run_dir / layout.CONFIG, OmegaConf.to_yaml(OmegaConf.create(config)))
    return config
