"""`task=evaluate`: test a checkpoint or a package, with nothing but that."""

import logging
from pathlib import Path

import torch
from omegaconf import DictConfig

from ljn.building import build
from ljn.data import DataModule
from ljn.modules.mesh_regressor import MeshRegressor
from ljn.refinement import Refiner, chosen_settings, second_look
from ljn.runs import layout
from ljn.runs.checkpoints import Checkpoint, load_state, read_checkpoint
from ljn.runs.files import read_metrics, write_json
from ljn.runs.identity import config_hash, identity
from ljn.runs.packages import STAGES
from ljn.runs.record import RunRecord, alone_in, is_complete
from ljn.tasks.overrides import check_bodies, typed_overrides, with_checkpoint_config
from ljn.tasks.package import chosen_package
from ljn.tasks.running import build_trainer, finite_metrics, prepare_process, save_config, set_run_directory
from ljn.tasks.tracking import tracking
from ljn.tasks.validation import validate

_LOG = logging.getLogger(__name__)


def evaluate(cfg: DictConfig) -> dict[str, float]:
    """Test a checkpoint on its own data, or on data changed by this call's overrides.

    Args:
        cfg: The composed configuration, whose `ckpt_path` names the checkpoint; or `weights` a package and `task.stage`
            its stage, of which a mesh regressor is tested on the joints of the package's detector. Model, data and
            trainer come from the checkpoint; of this call's overrides, those of single values of data, trainer and
            body are applied to them.

    Returns:
        The test metrics, with `refine` those of the refined meshes beside the others, also in `metrics.json` of the
        evaluation's directory.

    Raises:
        FileNotFoundError: There is no such checkpoint.
        ValueError: Of `ckpt_path` and `weights` not one is set; the checkpoint is damaged, or belongs to another model
            or body; or an override changes what the checkpoint decides.
    """
    if cfg.task.stage not in STAGES:
        raise ValueError(f"task.stage: expected one of {', '.join(STAGES)}, got {cfg.task.stage!r}")
    path = chosen_package(cfg, "ckpt_path") or cfg.ckpt_path
    if path is None:
        raise ValueError(
            "ckpt_path: expected the checkpoint to evaluate, got null; add ckpt_path=FILE, or weights=NAME"
        )
    return evaluate_checkpoint(cfg, path, typed_overrides(), stage=cfg.task.stage)


def evaluate_checkpoint(
    cfg: DictConfig,
    path: str | Path,
    overrides: list[str],
    name: str | None = None,
    reuses: bool = False,
    stage: str = "detector",
) -> dict[str, float]:
    """Test a checkpoint or a package's stage, with overrides of single values, as they would be typed; see `evaluate`.

    Sets `paths.run_dir` of the call's configuration. The evaluation has the checkpoint's name or `name`; with `reuses`,
    an equal evaluation, if there is a complete one, is taken instead.
    """
    checkpoint = read_checkpoint(path, stage=stage)
    settings = chosen_settings(cfg.refine)
    call, cfg = cfg, with_checkpoint_config(cfg, checkpoint, overrides)
    cfg.name = name or cfg.name
    validate(cfg)

    datamodule: DataModule = build(cfg.data)
    datamodule.prepare_data()
    evaluated = {**identity(cfg, datamodule.fingerprint), "checkpoint": checkpoint.file_hash}
    if settings is not None:
        evaluated["refine"] = settings
    identity_hash = config_hash(evaluated)
    run_dir = set_run_directory(cfg, "evaluations", identity_hash)
    call.paths.run_dir = str(run_dir)
    with alone_in(run_dir):
        if reuses and not call.rerun and is_complete(run_dir, identity_hash):
            _LOG.info("%s is complete; evaluate it again with rerun=true", run_dir)
            return read_metrics(run_dir) or {}
        return _evaluate(cfg, datamodule, checkpoint, run_dir, identity_hash, settings)


def _evaluate(
    cfg: DictConfig,
    datamodule: DataModule,
    checkpoint: Checkpoint,
    run_dir: Path,
    identity_hash: str,
    settings: str | None,
) -> dict[str, float]:
    prepare_process(cfg)
    module = build(cfg.module)
    if settings is not None:
        if not isinstance(module, MeshRegressor):
            raise ValueError(
                f"refine: {cfg.refine!r} fits meshes, and '{checkpoint.path}' is no mesh regressor; give one's "
                "checkpoint, or of weights task.stage=mesh"
            )
        module.refine_with(Refiner(module.body, settings), second_look(datamodule.detector))
        datamodule.takes = module.observes
    else:
        datamodule.takes = module.takes
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
        "refine": settings,
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
