"""`task=evaluate`: test a checkpoint, with nothing but the checkpoint."""

import logging
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from ljn.building import build, check_targets
from ljn.data import BodyDataModule
from ljn.runs import layout
from ljn.runs.checkpoints import CONFIG_GROUPS, Checkpoint, load_state, read_checkpoint
from ljn.runs.files import read_metrics, write_json
from ljn.runs.identity import config_hash, identity
from ljn.runs.record import RunRecord, alone_in, is_complete
from ljn.tasks.tracking import tracking
from ljn.tasks.train import (
    build_trainer,
    finite_metrics,
    prepare_process,
    save_config,
    set_run_directory,
)
from ljn.tasks.validation import validate

_LOG = logging.getLogger(__name__)

# Of `CONFIG_GROUPS`, which the checkpoint decides: those whose single values a call may change.
_OVERRIDABLE = ("data", "trainer", "body")
# What the checkpoint has no say in.
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
    return evaluate_checkpoint(cfg, cfg.ckpt_path, typed_overrides())


def typed_overrides() -> list[str]:
    """What was typed after `run.py`; nothing in a process that Hydra did not start."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def evaluate_checkpoint(
    cfg: DictConfig, path: str | Path, overrides: list[str], name: str | None = None, reuses: bool = False
) -> dict[str, float]:
    """Test a checkpoint; see `evaluate`.

    Args:
        cfg: The call's composed configuration; `paths.run_dir` is set here.
        path: The checkpoint.
        overrides: Changes of single values, as they would be typed.
        name: Name of the evaluation's directory and record; None for that of the checkpoint.
        reuses: Whether an equal evaluation, if there is a complete one, is taken instead.
    """
    checkpoint = read_checkpoint(path)
    call, cfg = cfg, with_checkpoint_config(cfg, checkpoint, overrides)
    cfg.name = name or cfg.name
    validate(cfg)

    datamodule: BodyDataModule = build(cfg.data)
    datamodule.prepare_data()
    evaluated = {**identity(cfg, datamodule.fingerprint), "checkpoint": checkpoint.file_hash}
    identity_hash = config_hash(evaluated)
    run_dir = set_run_directory(cfg, "evaluations", identity_hash)
    call.paths.run_dir = str(run_dir)
    with alone_in(run_dir):
        if reuses and not call.rerun and is_complete(run_dir, identity_hash):
            _LOG.info("%s is complete; evaluate it again with rerun=true", run_dir)
            return read_metrics(run_dir) or {}
        return _evaluate(cfg, datamodule, checkpoint, run_dir, identity_hash)


def _evaluate(
    cfg: DictConfig, datamodule: BodyDataModule, checkpoint: Checkpoint, run_dir: Path, identity_hash: str
) -> dict[str, float]:
    prepare_process(cfg)
    module = build(cfg.module)
    load_state(module, checkpoint)
    check_bodies(checkpoint, {body.hash for body in datamodule.bodies} | set(module.body_hashes))
    facts = {
        "name": cfg.name,
        "preset": cfg.preset.name,
        "config_hash": identity_hash,
        "trained_by": checkpoint.run,
        "checkpoint": {"path": str(checkpoint.path), "hash": checkpoint.file_hash, "epoch": checkpoint.epoch},
        "data": datamodule.describe(("test",)),
        **module.describe(),
        "predicted_body": "-".join(module.body_hashes) or None,
    }
    with RunRecord(run_dir, facts) as record:
        config = save_config(cfg, run_dir)
        trainer = build_trainer(cfg, run_dir, config, datamodule, module)
        record.add(device=str(trainer.strategy.root_device), num_threads=torch.get_num_threads())
        with tracking(trainer, identity_hash, config, trained_by=checkpoint.run):
            trainer.test(module, datamodule, verbose=False)
            metrics = finite_metrics(trainer)
        if trainer.is_global_zero:
            write_json(run_dir / layout.METRICS, metrics)
    _LOG.info("%s on %s: %s", checkpoint.run, cfg.name, run_dir)
    return metrics


def check_bodies(checkpoint: Checkpoint, hashes: set[str]) -> None:
    """Raise a `ValueError` unless a checkpoint was trained with the bodies of these hashes."""
    if unknown := checkpoint.unknown_bodies(hashes):
        raise ValueError(
            f"body: the checkpoint was trained with the bodies {checkpoint.body_hash}; {unknown[0]} is not among "
            "them. A model is only meaningful with its bodies: name them with body.path=FILE_OR_FOLDER and "
            "body.genders"
        )


def with_checkpoint_config(cfg: DictConfig, checkpoint: Checkpoint, overrides: list[str]) -> DictConfig:
    """The call's configuration with the checkpoint's model, data and trainer, and the overrides on top.

    Args:
        cfg: The call's composed configuration.
        checkpoint: The checkpoint.
        overrides: The call's overrides, as they were typed.

    Raises:
        ValueError: An override is about something that the checkpoint decides.
    """
    check_targets({name: checkpoint.config.get(name) for name in CONFIG_GROUPS}, "the checkpoint's config")
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=False)  # type: ignore[assignment]
    # What belongs to the machine rather than to the numbers stays this call's.
    of_machine = {
        "data": {name: plain["data"][name] for name in ("cache_dir", "num_workers", "prefetch_batches")},
        "trainer": {name: plain["trainer"][name] for name in ("accelerator", "devices", "strategy")},
    }
    plain |= {name: checkpoint.config[name] for name in CONFIG_GROUPS}
    plain |= {name: {**plain[name], **values} for name, values in of_machine.items()}
    merged = OmegaConf.create(plain)
    OmegaConf.set_struct(merged, True)
    apply_overrides(merged, overrides)
    return merged


def apply_overrides(cfg: DictConfig, overrides: list[str]) -> None:
    """Change single values of data, trainer and body in a resolved configuration.

    Args:
        cfg: What a checkpoint's configuration is part of.
        overrides: As they would be typed; those about what the checkpoint has no say in are left out.

    Raises:
        ValueError: An override is about something that the checkpoint decides, or names no value.
    """
    for override in OverridesParser.create().parse_overrides(overrides):
        key = override.key_or_group.replace("/", ".")
        group = key.split(".")[0]
        if group in _FROM_CALL:
            continue
        is_value = "/" not in override.key_or_group and not (override.is_delete() or override.is_add())
        if group not in _OVERRIDABLE or "." not in key or not is_value:
            raise ValueError(
                f"{override.input_line}: model, data and sizes come from the checkpoint; an evaluation can "
                f"change single values of {', '.join(_OVERRIDABLE)} (data.keypoint_noise_px=15) and choose "
                "callbacks, logger and paths"
            )
        _set(cfg, key, override.value(), override.input_line)


def _set(cfg: DictConfig, key: str, value: Any, line: str | None) -> None:
    current = OmegaConf.select(cfg, key, default=_MISSING)
    if isinstance(current, DictConfig):
        raise ValueError(
            f"{line}: '{key}' holds several values; change one of them: {', '.join(map(str, current))}"
        )
    if current is _MISSING:
        parent = OmegaConf.select(cfg, key.rpartition(".")[0])
        known = ", ".join(sorted(str(name) for name in parent)) if isinstance(parent, DictConfig) else "none"
        raise ValueError(f"{line}: the checkpoint's config has no key '{key}'; known there: {known}")
    OmegaConf.update(cfg, key, value)
    if key.startswith("body."):
        # The stored config is resolved: what was derived from the body's group has to follow by hand.
        for derived in _OF_BODY[key]:
            if OmegaConf.select(cfg, derived, default=_MISSING) is not _MISSING:
                OmegaConf.update(cfg, derived, value)


_OF_BODY = {
    "body.path": ("data.body_path", "module.body_path"),
    "body.genders": ("data.source.genders", "module.genders"),
    "body.predicted": ("module.predicted",),
}
_MISSING = object()
