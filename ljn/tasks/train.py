"""`task=train`: fit a model, then test its best checkpoint."""

import logging
import os
import warnings
from pathlib import Path
from typing import Any

import lightning.pytorch as lightning
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from ljn.data import BodyDataModule
from ljn.tasks import records
from ljn.tasks.building import build, build_each
from ljn.tasks.tracking import finish_tracking, link_run
from ljn.tasks.validation import validate

_LOG = logging.getLogger(__name__)
# What Lightning says of things that are as they should be.
_EXPECTED_WARNINGS = (
    ".*LeafSpec.* is deprecated",  # its own use of PyTorch
    ".*this fit will run with no optimizer",  # a yardstick
    "Checkpoint directory .* exists and is not empty",  # a resumed run
    "The number of training batches .* is smaller than the logging interval",
)


def train(cfg: DictConfig) -> dict[str, float]:
    """Train and test one configuration, or find it already done, or resume it where it was cut off.

    Args:
        cfg: The composed configuration; `paths.run_dir` is set here.

    Returns:
        The test metrics, also in `metrics.json` of the run's directory.

    Raises:
        ValueError: The configuration or the data it names is wrong; nothing expensive has been started then.
        FileNotFoundError: A file that it names is missing.
    """
    validate(cfg, is_multirun=is_multirun())
    datamodule: BodyDataModule = build(cfg.data)
    datamodule.prepare_data()
    identity = records.identity(cfg, datamodule.body.hash)
    identity_hash = records.config_hash(identity)
    output_dir = Path(cfg.paths.output_dir)
    run_dir = records.run_directory(output_dir, "runs", cfg.name, cfg.preset.name, identity_hash)
    with open_dict(cfg):
        cfg.paths.run_dir = str(run_dir)
    if records.is_complete(run_dir, identity_hash) and not cfg.rerun:
        _LOG.info("%s is complete; train it again with rerun=true", run_dir)
        return records.read_json(run_dir / "metrics.json") or {}

    prepare_process(cfg)
    module = build(cfg.module)
    last = run_dir / "checkpoints" / "last.ckpt"
    if cfg.rerun:
        last.unlink(missing_ok=True)
    facts = {
        "name": cfg.name,
        "preset": cfg.preset.name,
        "config_hash": identity_hash,
        "data": datamodule.describe(),
        "num_parameters": sum(parameter.numel() for parameter in module.parameters()),
    }
    with records.RunRecord(run_dir, facts) as record:
        config = save_config(cfg, run_dir)
        trainer = build_trainer(cfg, run_dir, config, datamodule)
        record.add(device=str(trainer.strategy.root_device), num_threads=torch.get_num_threads())
        link_run(trainer, identity_hash, config)
        try:
            if last.is_file():
                _LOG.info("resuming from %s", last)
            else:
                _LOG.info("training in %s", run_dir)
            trainer.fit(module, datamodule, ckpt_path=last if last.is_file() else None, weights_only=True)
            best = run_dir / "checkpoints" / "best.ckpt"
            if trainer.global_step == 0 or not best.is_file():
                # Without optimizer steps (a yardstick) or without validation, nothing was saved yet.
                trainer.save_checkpoint(best, weights_only=False)
            record.add(checkpoint=str(best.relative_to(run_dir)))
            metrics = test(trainer, module, datamodule, best)
            records.write_json(run_dir / "metrics.json", metrics)
        finally:
            finish_tracking(trainer)
    return metrics


def prepare_process(cfg: DictConfig) -> None:
    """Seed the global generators, share the cores between PyTorch and the data workers, quieten Lightning."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for message in _EXPECTED_WARNINGS:
        warnings.filterwarnings("ignore", message)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    # With a thread on every core, each parallel region waits for the one that shares its core with a worker.
    torch.set_num_threads(cfg.num_threads or max(1, (os.cpu_count() or 1) // 2))


def build_trainer(
    cfg: DictConfig, run_dir: Path, config: dict[str, Any], datamodule: BodyDataModule
) -> lightning.Trainer:
    """The trainer with its callbacks and loggers, writing below the run's directory."""
    from callbacks.provenance import Provenance

    provenance = Provenance(config, datamodule.body.hash, datamodule.licence, run_dir.name)
    return build(
        cfg.trainer,
        default_root_dir=str(run_dir),
        callbacks=[*build_each(cfg.callbacks), provenance],
        logger=build_each(cfg.logger),
    )


def test(
    trainer: lightning.Trainer,
    module: lightning.LightningModule,
    datamodule: BodyDataModule,
    ckpt_path: Path | None,
) -> dict[str, float]:
    """The test metrics of a checkpoint, or of the module as it is."""
    [metrics] = trainer.test(module, datamodule, ckpt_path=ckpt_path, verbose=False, weights_only=True)
    return {name: float(value) for name, value in metrics.items()}


def save_config(cfg: DictConfig, run_dir: Path) -> dict[str, Any]:
    """Write `config.yaml`, resolved; returns the same as plain values."""
    config: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    (run_dir / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    return config


def is_multirun() -> bool:
    """Whether Hydra runs a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
