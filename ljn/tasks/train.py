"""`task=train`: fit a model, then test its best checkpoint."""

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
from ljn.data import BodyDataModule
from ljn.modules.base import StageModule
from ljn.runs.checkpoints import AtomicCheckpointIO, Provenance, read_checkpoint
from ljn.runs.files import path_part, read_json, write_json, write_text_atomically
from ljn.runs.identity import config_hash, identity
from ljn.runs.random_state import RandomState
from ljn.runs.record import RunRecord, alone_in, is_complete
from ljn.tasks.processes import check_trains_in_processes, is_first_process, num_processes, own_devices
from ljn.tasks.tracking import tracking
from ljn.tasks.validation import validate

_LOG = logging.getLogger(__name__)
# What Lightning says of things that are as they should be.
_EXPECTED_WARNINGS = (
    ".*LeafSpec.* is deprecated",  # its own use of PyTorch
    ".*this fit will run with no optimizer",  # a yardstick
    "Checkpoint directory .* exists and is not empty",  # a resumed run
    "The number of training batches .* is smaller than the logging interval",
    "It is recommended to use .*sync_dist=True",  # metrics gather themselves over processes
)


def train(cfg: DictConfig) -> dict[str, float]:
    """Train and test one configuration, or find it already done, or resume it where it was cut off.

    Args:
        cfg: The composed configuration; `paths.run_dir` is set here.

    Returns:
        The best checkpoint's validation and test metrics, also in `metrics.json` of the run's directory.

    Raises:
        ValueError: The configuration or the data it names is wrong; nothing expensive has been started then.
        FileNotFoundError: A file that it names is missing.
        FloatingPointError: The loss or a metric is not finite.
    """
    if cfg.ckpt_path is not None:
        raise ValueError(
            "ckpt_path: it is what task=evaluate reads; a training resumes from its own directory by itself"
        )
    validate(cfg)
    datamodule: BodyDataModule = build(cfg.data)
    datamodule.prepare_data()
    identity_hash = config_hash(identity(cfg, datamodule.fingerprint))
    run_dir = set_run_directory(cfg, "runs", identity_hash)
    with alone_in(run_dir):
        if is_complete(run_dir, identity_hash) and not cfg.rerun:
            _LOG.info("%s is complete; train it again with rerun=true", run_dir)
            return read_json(run_dir / "metrics.json") or {}
        return _train(cfg, datamodule, run_dir, identity_hash)


def _train(
    cfg: DictConfig, datamodule: BodyDataModule, run_dir: Path, identity_hash: str
) -> dict[str, float]:
    prepare_process(cfg)
    module = build(cfg.module)
    check_trains_in_processes(module, num_processes(cfg.trainer))
    last, best = (run_dir / "checkpoints" / f"{name}.ckpt" for name in ("last", "best"))
    if cfg.rerun and is_first_process():
        last.unlink(missing_ok=True)
    resumes = last.is_file()
    if resumes:
        read_checkpoint(last)  # a damaged one is named before anything starts
    facts = {
        "name": cfg.name,
        "preset": cfg.preset.name,
        "config_hash": identity_hash,
        "data": datamodule.describe(),
        "predicted_body": "-".join(module.body_hashes) or None,
        "num_parameters": sum(parameter.numel() for parameter in module.parameters()),
    }
    with RunRecord(run_dir, facts) as record:
        config = save_config(cfg, run_dir)
        trainer = build_trainer(cfg, run_dir, config, datamodule, module)
        record.add(
            device=str(trainer.strategy.root_device),
            num_devices=trainer.world_size,
            num_threads=torch.get_num_threads(),
        )
        _LOG.info(f"resuming from {last}" if resumes else f"training in {run_dir}")
        # The fixed sets first: what is wrong with them should not come up after the training.
        datamodule.setup("fit")
        datamodule.setup("test")
        with tracking(trainer, identity_hash, config):
            trainer.fit(module, datamodule, ckpt_path=last if resumes else None, weights_only=True)
            # Without optimizer steps (a yardstick) or without validation, nothing was saved yet. All processes save
            # together, so the first one's look at the disk counts for all.
            if trainer.strategy.broadcast(trainer.global_step == 0 or not best.is_file()):
                trainer.save_checkpoint(best, weights_only=False)
            record.add(checkpoint=str(best.relative_to(run_dir)))
            trainer.validate(module, datamodule, ckpt_path=best, verbose=False, weights_only=True)
            metrics = finite_metrics(trainer)
            trainer.test(module, datamodule, ckpt_path=best, verbose=False, weights_only=True)
            metrics |= finite_metrics(trainer)
        if trainer.is_global_zero:
            write_json(run_dir / "metrics.json", metrics)
    return metrics


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
    # With a thread on every core, each parallel region waits for the one that shares its core with a worker.
    number = num_processes(cfg.trainer)
    num_threads = cfg.num_threads or max(1, _num_cores() // (2 * number))
    torch.set_num_threads(num_threads)
    if number > 1:
        # Where this is not set, Lightning gives each of several processes its share of all cores.
        os.environ.setdefault("OMP_NUM_THREADS", str(num_threads))


def _num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def build_trainer(
    cfg: DictConfig, run_dir: Path, config: dict[str, Any], datamodule: BodyDataModule, module: StageModule
) -> lightning.Trainer:
    """The trainer with its callbacks and loggers, writing below the run's directory."""
    body_hashes = {*datamodule.body_hash.split("-"), *module.body_hashes}
    provenance = Provenance(config, "-".join(sorted(body_hashes)), datamodule.licence, run_dir.name)
    return build(
        cfg.trainer,
        default_root_dir=str(run_dir),
        callbacks=[*build_each(cfg.callbacks), provenance, RandomState()],
        logger=build_each(cfg.logger),
        plugins=[AtomicCheckpointIO()],
        use_distributed_sampler=False,  # the data module gives each process its part, and none twice
        **own_devices(cfg.trainer),
    )


def finite_metrics(trainer: lightning.Trainer) -> dict[str, float]:
    """The metrics of the trainer's last validation or test.

    Raises:
        FloatingPointError: One of them is not finite.
    """
    metrics = {name: float(value) for name, value in trainer.callback_metrics.items()}
    bad = [name for name, value in metrics.items() if not math.isfinite(value)]
    if bad:
        raise FloatingPointError(
            f"{', '.join(bad)} not finite: the model predicts NaN or infinity; lower the learning rate"
        )
    return metrics


def save_config(cfg: DictConfig, run_dir: Path) -> dict[str, Any]:
    """Write `config.yaml`, resolved, in the first process; returns the same as plain values."""
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    if is_first_process():
        write_text_atomically(run_dir / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(config)))
    return config
