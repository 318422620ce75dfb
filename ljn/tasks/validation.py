"""What types alone cannot say about a configuration, checked before data is read or a model is built."""

import tempfile
from pathlib import Path
from typing import Any

from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ljn.body.skeleton import JOINT_NAMES, NUM_JOINTS
from ljn.building import check_targets
from ljn.tasks.processes import check_processes


def validate(cfg: DictConfig) -> None:
    """Raise a `ValueError` that names the key, what was expected, what came and the fix."""
    try:
        plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
    except OmegaConfBaseException as error:
        raise ValueError(f"config: {error}".split("\n")[0]) from error
    unread = [name for name in ("input", "camera", "keypoints", "mask", "mesh_ckpt_path") if plain.get(name)]
    if unread:
        raise ValueError(
            f"{', '.join(unread)}: only task=predict reads this; add task=predict, or leave it out"
        )
    check_targets(plain)
    _check_radii(plain.get("model") or {})
    _check_integers(plain)
    _check_monitors(plain)
    check_processes(plain)
    for name in ("output_dir", "cache_dir"):
        check_writable(Path(plain["paths"][name]), f"paths.{name}")


def check_writable(directory: Path, name: str = "paths.output_dir") -> None:
    """Raise a `ValueError` unless files can be written in a directory, made where it is missing."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise ValueError(
            f"{name}: cannot write in '{directory}' ({error.strerror}); choose another one with {name}=DIRECTORY"
        ) from error


def _check_radii(model: dict[str, Any]) -> None:
    radii = model.get("radii_m")
    if "radii_m" in model and not (isinstance(radii, list) and len(radii) == NUM_JOINTS):
        got = len(radii) if isinstance(radii, list) else repr(radii)
        raise ValueError(
            f"model.radii_m: expected {NUM_JOINTS} radii, one for each joint ({', '.join(JOINT_NAMES)}), got {got}"
        )


def _check_integers(plain: dict[str, Any]) -> None:
    smallest: dict[int, dict[str, tuple[str, ...]]] = {
        1: {
            "data": ("num_points", "num_train", "num_val", "num_test", "batch_size", "prefetch_batches"),
            "model": ("group_size",),
            "trainer": ("max_epochs",),
        },
        0: {"data": ("num_workers", "seed", "pool_seed", "eval_seed")},
    }
    for least, groups in smallest.items():
        for group, keys in groups.items():
            for key in keys:
                values = plain.get(group) or {}
                if key in values and not (isinstance(values[key], int) and values[key] >= least):
                    raise ValueError(
                        f"{group}.{key}: expected an integer of {least} or more, got {values[key]!r}"
                    )
    if plain["num_threads"] is not None and plain["num_threads"] < 1:
        raise ValueError(f"num_threads: expected 1 or more, or null, got {plain['num_threads']}")


def _check_monitors(plain: dict[str, Any]) -> None:
    # The module says what it logs; its target has passed `check_targets`.
    module: Any = get_class(plain["module"]["_target_"])
    keys = list(module.metrics().keys(keep_base=True))
    known = {f"val/{key}" for key in keys} | {"train/loss"}
    monitored: dict[str, tuple[Any, set[str]]] = {
        f"callbacks.{name}.monitor": ((node or {}).get("monitor"), known)
        for name, node in (plain.get("callbacks") or {}).items()
    }
    monitored["optimized_metric"] = (plain["optimized_metric"], known | {f"test/{key}" for key in keys})
    for name, (metric, choices) in monitored.items():
        if metric is not None and metric not in choices:
            raise ValueError(
                f"{name}: no metric '{metric}' is logged; choose one of {', '.join(sorted(choices))}"
            )
