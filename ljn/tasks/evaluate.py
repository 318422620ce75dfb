"""`task=evaluate`: test a checkpoint, with nothing but the checkpoint."""

import logging
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf, open_dict

from ljn.data import BodyDataModule
from ljn.tasks import records
from ljn.tasks.building import build, check_targets
from ljn.tasks.checkpoints import Checkpoint, load_state, read_checkpoint
from ljn.tasks.tracking import finish_tracking, link_run
from ljn.tasks.train import build_trainer, is_multirun, prepare_process, save_config, test
from ljn.tasks.validation import validate

_LOG = logging.getLogger(__name__)

# Whose values a checkpoint decides, and whose this call does.
_FROM_CHECKPOINT = ("preset", "model", "module", "data", "body", "trainer", "seed", "name")
_OVERRIDABLE = ("data", "trainer", "body")
_FROM_CALL = (
    "task",
    "callbacks",
    "logger",
    "paths",
    "hydra",
    "num_threads",
    "ckpt_path",
    "rerun",
    "tags",
    "group",
    "sweep",
)


def evaluate(cfg: DictConfig) -> dict[str, float]:
    """Test a checkpoint on its own data, or on data changed by this call's overrides.

    Args:
        cfg: The composed configuration, whose `ckpt_path` names the checkpoint. Model, data and trainer come
            from the checkpoint; of this call's overrides, those of single values of data, trainer and body
            are applied to them.

    Returns:
        The test metrics, also in `metrics.json` of the evaluation's directory.

    Raises:
        FileNotFoundError: There is no such checkpoint.
        ValueError: `ckpt_path` is not set; the checkpoint is damaged, or belongs to another model or body; or
            an override changes what the checkpoint decides.
    """
    if cfg.ckpt_path is None:
        raise ValueError("ckpt_path: expected the checkpoint to evaluate, got null; add ckpt_path=FILE")
    checkpoint = read_checkpoint(cfg.ckpt_path)
    overrides = list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []
    cfg = with_checkpoint_config(cfg, checkpoint, overrides)
    validate(cfg, is_multirun=is_multirun())

    datamodule: BodyDataModule = build(cfg.data)
    datamodule.prepare_data()
    if datamodule.body.hash != checkpoint.body_hash:
        raise ValueError(
            f"body: the checkpoint was trained with the body {checkpoint.body_hash}, this is "
            f"{datamodule.body.hash}; a model is only meaningful with its body: name it with body.path=FILE"
        )
    identity = {**records.identity(cfg, datamodule.body.hash), "checkpoint": checkpoint.file_hash}
    identity_hash = records.config_hash(identity)
    output_dir = Path(cfg.paths.output_dir)
    run_dir = records.run_directory(output_dir, "evaluations", cfg.name, cfg.preset.name, identity_hash)
    with open_dict(cfg):
        cfg.paths.run_dir = str(run_dir)

    prepare_process(cfg)
    module = build(cfg.module)
    load_state(module, checkpoint)
    facts = {
        "name": cfg.name,
        "preset": cfg.preset.name,
        "config_hash": identity_hash,
        "trained_by": checkpoint.run,
        "checkpoint": {"path": str(checkpoint.path), "hash": checkpoint.file_hash, "epoch": checkpoint.epoch},
        "data": datamodule.describe(),
    }
    with records.RunRecord(run_dir, facts) as record:
        config = save_config(cfg, run_dir)
        trainer = build_trainer(cfg, run_dir, config, datamodule)
        record.add(device=str(trainer.strategy.root_device), num_threads=torch.get_num_threads())
        link_run(trainer, identity_hash, config, trained_by=checkpoint.run)
        try:
            metrics = test(trainer, module, datamodule, ckpt_path=None)
            records.write_json(run_dir / "metrics.json", metrics)
        finally:
            finish_tracking(trainer)
    _LOG.info("%s on %s: %s", checkpoint.run, cfg.name, run_dir)
    return metrics


def with_checkpoint_config(cfg: DictConfig, checkpoint: Checkpoint, overrides: list[str]) -> DictConfig:
    """The call's configuration with the checkpoint's model, data and trainer, and the overrides on top.

    Args:
        cfg: The call's composed configuration.
        checkpoint: The checkpoint.
        overrides: The call's overrides, as they were typed.

    Raises:
        ValueError: An override is about something that the checkpoint decides.
    """
    check_targets({name: checkpoint.config.get(name) for name in _FROM_CHECKPOINT}, "the checkpoint's config")
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=False)  # type: ignore[assignment]
    plain |= {name: checkpoint.config[name] for name in _FROM_CHECKPOINT}
    merged = OmegaConf.create(plain)
    merged.data.cache_dir = "${paths.cache_dir}"
    OmegaConf.set_struct(merged, True)
    for override in OverridesParser.create().parse_overrides(overrides):
        key = override.key_or_group.replace("/", ".")
        group = key.split(".")[0]
        if group in _FROM_CALL:
            continue
        if group not in _OVERRIDABLE or "." not in key:
            raise ValueError(
                f"{override.input_line}: model, data and sizes come from the checkpoint; an evaluation can "
                f"change single values of {', '.join(_OVERRIDABLE)} (data.keypoint_noise_px=15) and choose "
                f"{', '.join(_FROM_CALL[1:4])}"
            )
        _set(merged, key, override.value(), override.input_line)
    return merged


def _set(cfg: DictConfig, key: str, value: Any, line: str | None) -> None:
    if OmegaConf.select(cfg, key, default=_MISSING) is _MISSING:
        parent = OmegaConf.select(cfg, key.rpartition(".")[0])
        known = ", ".join(sorted(str(name) for name in parent)) if isinstance(parent, DictConfig) else "none"
        raise ValueError(f"{line}: the checkpoint's config has no key '{key}'; known there: {known}")
    OmegaConf.update(cfg, key, value)
    if key.startswith("body."):
        # The stored config is resolved: what was derived from the body's group has to follow by hand.
        cfg.data[f"body_{key.removeprefix('body.')}"] = value


_MISSING = object()
