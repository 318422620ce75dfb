"""`task=train`: fit a model, then test its best checkpoint."""

import logging
from pathlib import Path
from typing import Any

import torch
from hydra import compose
from hydra.utils import get_class
from omegaconf import DictConfig, open_dict

from ljn.building import build
from ljn.data import DataModule
from ljn.refinement import chosen_settings
from ljn.runs import layout
from ljn.runs.checkpoints import Checkpoint, begin_with, read_checkpoint
from ljn.runs.files import read_metrics, write_json
from ljn.runs.identity import config_hash, identity
from ljn.runs.keys import Key, key_of, kind_of
from ljn.runs.packages import find_package, is_package, shipped
from ljn.runs.record import RunRecord, alone_in, is_complete
from ljn.tasks.overrides import typed_overrides
from ljn.tasks.processes import check_trains_in_processes, is_first_process, num_processes
from ljn.tasks.running import build_trainer, finite_metrics, prepare_process, save_config, set_run_directory
from ljn.tasks.tracking import tracking
from ljn.tasks.validation import validate

_LOG = logging.getLogger(__name__)


def train(cfg: DictConfig) -> dict[str, float]:
    """Train and test one configuration, or find it already done, or resume it where it was cut off.

    Returns:
        The best checkpoint's validation and test metrics, also in `metrics.json` of the run's directory.

    Raises:
        ValueError: The configuration or the data it names is wrong; nothing expensive has been started then.
        FileNotFoundError: A file that it names is missing.
        FloatingPointError: The loss or a metric is not finite.
    """
    for key in ("ckpt_path", "weights"):
        if cfg[key] is not None:
            raise ValueError(
                f"{key}: it is what task=evaluate reads; a training resumes from its own directory by itself"
            )
    if chosen_settings(cfg.refine) is not None:
        raise ValueError(
            f"refine: {cfg.refine!r} fits meshes of task=predict, evaluate and demo, not of a training; leave it "
            "out, and evaluate the run with it"
        )
    validate(cfg)
    initial = _earlier_stages(cfg)
    datamodule: DataModule = build(cfg.data)
    datamodule.prepare_data()
    begun_with = {} if initial is None else {"begins_with": initial.file_hash}
    identity_hash = config_hash(identity(cfg, datamodule.fingerprint) | begun_with)
    run_dir = set_run_directory(cfg, "runs", identity_hash)
    with alone_in(run_dir):
        if is_complete(run_dir, identity_hash) and not cfg.rerun:
            _LOG.info("%s is complete; train it again with rerun=true", run_dir)
            return read_metrics(run_dir) or {}
        return _train(cfg, datamodule, run_dir, identity_hash, initial)


def _earlier_stages(cfg: DictConfig) -> Checkpoint | None:
    """Train, or find trained, what this training builds upon.

    Names the detector's checkpoint in the data's settings; returns the checkpoint that the weights begin with, if any.
    """
    detector, begins_with = cfg.task.get("detector"), cfg.task.get("begins_with")
    if detector is not None:
        path = trained(composed(detector), detector)
        with open_dict(cfg):
            cfg.data.detector_ckpt = str(path)
    if begins_with is None:
        return None
    argument = "task.begins_with"
    if begins_with in shipped() or is_package(begins_with):
        module: Any = get_class(cfg.module._target_)
        return read_checkpoint(find_package(begins_with, argument), argument, module.stage)
    if Path(begins_with).suffix == Path(layout.BEST_CHECKPOINT).suffix:
        return read_checkpoint(begins_with, argument)
    return read_checkpoint(trained(composed(begins_with, is_same_stage=True), begins_with), argument)


def trained(cfg: DictConfig, name: str) -> Path:
    """The best checkpoint of a configuration, trained here if need be."""
    with open_dict(cfg):
        cfg.name = name
        cfg.rerun = False  # that of the evaluation is meant
    train(cfg)
    return Path(cfg.paths.run_dir) / layout.BEST_CHECKPOINT


def composed(experiment: str, is_same_stage: bool = False) -> DictConfig:
    """The configuration of another experiment with this call's sizes, data, trainer and the like.

    Of the same stage, with all that is not the task's.
    """
    lines = [(line, kind_of(key_of(line))) for line in typed_overrides()]
    shared = [
        line
        for line, kind in lines
        if kind.is_shared or (is_same_stage and not kind & Key.TASK and key_of(line) != "experiment")
    ]
    return compose("config", [f"experiment={experiment}", *shared])


def _train(
    cfg: DictConfig, datamodule: DataModule, run_dir: Path, identity_hash: str, initial: Checkpoint | None
) -> dict[str, float]:
    prepare_process(cfg)
    module = build(cfg.module)
    if initial is not None:
        anew = begin_with(module, initial, "task.begins_with")
        if anew:
            _LOG.info("begins with '%s', but for %s, of another shape", initial.path, ", ".join(anew))
    datamodule.takes = module.takes
    check_trains_in_processes(module, num_processes(cfg.trainer))
    last, best = run_dir / layout.LAST_CHECKPOINT, run_dir / layout.BEST_CHECKPOINT
    if cfg.rerun and is_first_process():
        last.unlink(missing_ok=True)
    resumes = last.is_file()
    if resumes:
        read_checkpoint(last)  # a damaged one is named before anything starts
    facts = {
        "name": cfg.name,
        "preset": cfg.preset.name,
        "overrides": typed_overrides(),
        "config_hash": identity_hash,
        "begins_with": None if initial is None else {"path": str(initial.path), "hash": initial.file_hash},
        "data": datamodule.describe(),
        **module.describe(),
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
            write_json(run_dir / layout.METRICS, metrics)
    return metrics
