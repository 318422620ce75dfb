"""`task=package`: the weights of one or both stages as one file to ship; and the package that a call names."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from ljn.pipeline.keypoint_finder import KeypointFinder
from ljn.pipeline.pipeline import Pipeline
from ljn.runs import layout
from ljn.runs.checkpoints import Checkpoint, for_package, read_checkpoint
from ljn.runs.files import read_json
from ljn.runs.keys import CONFIG_GROUPS, Key, key_of, kind_of
from ljn.runs.packages import NAME, PRECISIONS, SUFFIX, find_package, write_package
from ljn.tasks.validation import check_writable

_LOG = logging.getLogger(__name__)
_COMMAND = (
    "python run.py task=package ckpt_path=DETECTOR.ckpt mesh_ckpt_path=MESH.ckpt task.name=NAME "
    "task.licence=CC-BY-4.0"
)
_OF_RECORD = (
    *("commit", "is_dirty", "begins_with", "num_parameters", "wall_time_s", "device", "versions", "started"),
)


def package(cfg: DictConfig) -> dict[str, float]:
    """Write a package and its line of the folder's index: of a joint detector and, if there is one, a mesh regressor;
    or of a keypoint detector.

    Nothing in it names a place on this machine: paths in the configurations become null.

    Args:
        cfg: The composed configuration; of it `task`, `ckpt_path`, `body.path` and `paths` count.

    Returns:
        `package/megabytes`, and for each stage `package/STAGE_rounding`, the relative difference, in percent, that the
        precision makes to the weights (their root mean square).

    Raises:
        FileNotFoundError: There is no such checkpoint.
        ValueError: A key is missing, or a checkpoint is wrong; see `Pipeline.load`.
    """
    task = cfg.task
    of_keypoints = task.keypoint_detector is not None
    if of_keypoints and (cfg.ckpt_path is not None or task.mesh_ckpt_path is not None):
        raise ValueError(
            "keypoint_detector, ckpt_path: a package holds a keypoint detector or the two other stages, got both; "
            "write two"
        )
    for key in ("task.keypoint_detector" if of_keypoints else "ckpt_path", "task.name", "task.licence"):
        if not isinstance(value := OmegaConf.select(cfg, key), str) or not value:
            raise ValueError(f"{key}: expected text, got {value!r}; {_COMMAND}")
    if not NAME.fullmatch(task.name):
        raise ValueError(
            f"task.name: expected letters, digits, '_', '-' and '.', to name a file, got '{task.name}'; {_COMMAND}"
        )
    if task.precision not in PRECISIONS:
        raise ValueError(
            f"task.precision: expected one of {', '.join(PRECISIONS)}, got {task.precision!r}; leave it out for int8"
        )
    directory = Path(task.directory or Path(cfg.paths.output_dir) / "packages")
    check_writable(directory, "task.directory")
    if of_keypoints:
        KeypointFinder.load(task.keypoint_detector, name="task.keypoint_detector")
        checkpoints = {"keypoints": read_checkpoint(task.keypoint_detector, "task.keypoint_detector")}
    else:
        # The two fit each other and the body.
        Pipeline.load(cfg.ckpt_path, task.mesh_ckpt_path, body_path=cfg.body.path)
        checkpoints = {"detector": read_checkpoint(cfg.ckpt_path)}
        if task.mesh_ckpt_path is not None:
            checkpoints["mesh"] = read_checkpoint(task.mesh_ckpt_path, "task.mesh_ckpt_path", "mesh")
    path = directory / f"{task.name}{SUFFIX}"
    trainings = {name: _training(each) for name, each in checkpoints.items()}
    if "mesh" in checkpoints:
        _check_trained_on(checkpoints["detector"], trainings["mesh"].get("detector"))
    stages = {name: for_package(each, _config(each), trainings[name]) for name, each in checkpoints.items()}
    states = {name: each.state for name, each in checkpoints.items()}
    write_package(path, task.name, task.licence, stages, states, task.precision)

    metrics = {"package/megabytes": path.stat().st_size / 1e6}
    for name, each in checkpoints.items():
        metrics[f"package/{name}_rounding"] = _rounding(each, read_checkpoint(path, "task.name", name))
    _LOG.info("%s of %s: %s", " and ".join(stages), task.name, path)
    return metrics


def chosen_package(cfg: DictConfig, *instead_of: str) -> Path | None:
    """The file of the package that `weights` names; None where it is null.

    Raises:
        FileNotFoundError: See `find_package`.
        ValueError: See `find_package`; or a key of `instead_of` has a value, too.
    """
    if cfg.weights is None:
        return None
    for key in instead_of:
        if OmegaConf.select(cfg, key) is not None:
            raise ValueError(
                f"weights, {key}: expected one of them, got both; weights={cfg.weights} stands for all checkpoints"
            )
    return find_package(cfg.weights)


def _config(checkpoint: Checkpoint) -> dict[str, Any]:
    """The part of a checkpoint's configuration that decides what it is, without this machine's paths."""
    return {group: _without_paths(checkpoint.config[group]) for group in CONFIG_GROUPS}


def _without_paths(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: None if _is_place(name) else _without_paths(entry) for name, entry in value.items()}
    return [_without_paths(entry) for entry in value] if isinstance(value, list) else value


def _is_place(key: str) -> bool:
    """Whether a key's value is a place on the machine, by the last part of its name."""
    return key.rpartition(".")[2].rpartition("_")[2] in ("path", "dir", "directory", "ckpt")


def _training(checkpoint: Checkpoint) -> dict[str, Any]:
    """What the run's directory says of the training: its record, its command, the best checkpoint's metrics."""
    directory = checkpoint.path.absolute().parent.parent
    about: dict[str, Any] = {"run": checkpoint.run, "epochs": checkpoint.epoch}
    record = read_json(directory / layout.RECORD)
    if directory.name != checkpoint.run or record is None:
        _LOG.warning(
            "'%s' does not lie in its run's directory, %s: the package will not say how it was trained, nor its errors",
            checkpoint.path,
            checkpoint.run,
        )
        return about
    about |= _without_paths({key: record.get(key) for key in _OF_RECORD})
    data = record.get("data")
    about["detector"] = _without_paths(data.get("detector")) if isinstance(data, dict) else None
    if isinstance(overrides := record.get("overrides"), list):
        about["command"] = " ".join(["python run.py", *filter(_is_of_training, map(str, overrides))])
    if checkpoint.path.name == Path(layout.BEST_CHECKPOINT).name:
        about["metrics"] = read_json(directory / layout.METRICS)
    return about


def _check_trained_on(detector: Checkpoint, trained_on: Any) -> None:
    """Warn where a mesh regressor was trained on another detector's joints."""
    if isinstance(trained_on, dict) and trained_on.get("hash") != detector.file_hash:
        _LOG.warning(
            "the mesh regressor was trained on the joints of another detector, %s, than this one, %s",
            trained_on.get("hash"),
            detector.file_hash,
        )


def _is_of_training(override: str) -> bool:
    key = key_of(override)
    return bool(kind_of(key) & (Key.RUN | Key.THROUGH | Key.CHOICE | Key.TASK)) and not _is_place(key)


def _rounding(exact: Checkpoint, stored: Checkpoint) -> float:
    """The relative difference of two checkpoints' floating-point entries, percent."""
    names = [name for name, value in exact.state.items() if value.is_floating_point()]
    if not names:
        return 0.0
    first, second = (
        torch.cat([each.state[name].double().flatten() for name in names]) for each in (exact, stored)
    )
    return 100 * float((first - second).norm() / first.norm().clamp(min=1e-30))
