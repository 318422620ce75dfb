"""What types alone cannot say about a configuration, checked before data is read or a model is built."""

import math
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ljn.body.skeleton import JOINT_NAMES, NUM_JOINTS
from ljn.building import check_targets
from ljn.report.tables import TABLES
from ljn.tasks.processes import check_processes


def validate(cfg: DictConfig) -> None:
    """Raise a `ValueError` that names the key, what was expected, what came and the fix."""
    try:
        plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
    except OmegaConfBaseException as error:
        raise ValueError(f"config: {error}".split("\n")[0]) from error
    check_targets({name: value for name, value in plain.items() if name != "task"})
    _check_radii(plain.get("model") or {})
    _check_integers(plain)
    _check_set_abstractions(plain)
    _check_learning_rate(plain)
    _check_monitors(plain)
    _check_tables(plain)
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
    radii = model.get("radii_m", [0] * NUM_JOINTS)
    if not (isinstance(radii, list) and len(radii) == NUM_JOINTS):
        got = len(radii) if isinstance(radii, list) else repr(radii)
        raise ValueError(
            f"model.radii_m: expected {NUM_JOINTS} radii, one for each joint ({', '.join(JOINT_NAMES)}), got {got}"
        )


def _check_integers(plain: dict[str, Any]) -> None:
    smallest = (
        ("data.observation", 1, ("num_points", "crop_px")),
        ("data", 1, ("num_train", "num_val", "num_test", "batch_size", "prefetch_batches")),
        ("data", 0, ("num_workers", "seed", "pool_seed", "eval_seed")),
        ("model", 1, ("group_size",)),
        ("trainer", 1, ("max_epochs",)),
    )
    for group, least, keys in smallest:
        values = _group(plain, group)
        for key in keys:
            if key in values and not (isinstance(values[key], int) and values[key] >= least):
                raise ValueError(
                    f"{group}.{key}: expected an integer of {least} or more, got {values[key]!r}"
                )
    if plain["num_threads"] is not None and plain["num_threads"] < 1:
        raise ValueError(f"num_threads: expected 1 or more, or null, got {plain['num_threads']}")


def _group(plain: Any, key: str) -> dict[str, Any]:
    """The mapping under a key with dots; empty where there is none."""
    for part in key.split("."):
        plain = plain.get(part) if isinstance(plain, dict) else None
    return plain if isinstance(plain, dict) else {}


def _check_set_abstractions(plain: dict[str, Any]) -> None:
    trunk = _group(plain, "model.trunk")
    for key in ("num_centres", "group_sizes"):
        values = trunk.get(key, [1])
        if not (isinstance(values, list) and values and all(isinstance(n, int) and n >= 1 for n in values)):
            raise ValueError(
                f"model.trunk.{key} (preset.mesh.{key}): expected an integer of 1 or more for each set abstraction, "
                f"got {values!r}"
            )
    if "num_centres" not in trunk:
        return
    centres, name = trunk["num_centres"], "model.trunk.num_centres (preset.mesh.num_centres)"
    if sorted(centres, reverse=True) != centres:
        raise ValueError(
            f"{name}: expected no number greater than the one before, got {centres}: each set abstraction takes its "
            f"centres from those before; set preset.mesh.num_centres={_as_override(sorted(centres, reverse=True))}"
        )
    num_points = _group(plain, "data.observation").get("num_points")
    if num_points is not None and centres[0] > num_points:
        fitting = _as_override(min(number, num_points) for number in centres)
        raise ValueError(
            f"{name}: expected at most data.observation.num_points={num_points} centres, since they are taken from the "
            f"cloud's points, got {centres}; set data.observation.num_points={centres[0]} or more, or "
            f"preset.mesh.num_centres={fitting}"
        )


def _as_override(values: Iterable[int]) -> str:
    return f"[{','.join(map(str, values))}]"


def _check_learning_rate(plain: dict[str, Any]) -> None:
    rate = _group(plain, "module.optimizer").get("lr", 1)
    if not (type(rate) in (int, float) and 0 < rate < math.inf):
        raise ValueError(
            f"module.optimizer.lr: expected a positive finite number, got {rate!r}; set preset.learning_rate=1e-3 "
            "(of a mesh regressor: preset.mesh.learning_rate=1e-3)"
        )


def _check_tables(plain: dict[str, Any]) -> None:
    if unknown := [name for name in plain["tables"] if name not in TABLES]:
        raise ValueError(f"tables: expected some of {', '.join(TABLES)}, got {', '.join(unknown)}")


def _check_monitors(plain: dict[str, Any]) -> None:
    # The module says what it logs; its target has passed `check_targets`.
    module: Any = get_class(plain["module"]["_target_"])
    metrics = module.metrics().items()
    modes = {
        f"val/{key}": {True: "max", False: "min"}.get(metric.higher_is_better) for key, metric in metrics
    }
    modes["train/loss"] = "min"
    callbacks = {f"callbacks.{name}": node for name, node in _group(plain, "callbacks").items() if node}
    monitored = {f"{name}.monitor": (node.get("monitor"), set(modes)) for name, node in callbacks.items()}
    monitored["optimized_metric"] = (
        plain["optimized_metric"],
        {*modes, *(f"test/{key}" for key, _ in metrics)},
    )
    for name, (metric, choices) in monitored.items():
        if metric is not None and metric not in choices:
            raise ValueError(
                f"{name}: no metric '{metric}' is logged; choose one of {', '.join(sorted(choices))}"
            )
    for name, node in callbacks.items():
        if node.get("monitor") is None or "mode" not in node:
            continue
        metric, mode = node["monitor"], node["mode"]
        if modes[metric] is None:
            raise ValueError(
                f"{name}.monitor: '{metric}' describes the data, and no model makes it better; choose another of "
                f"{', '.join(sorted(key for key, wanted in modes.items() if wanted))}"
            )
        if mode != modes[metric]:
            raise ValueError(
                f"{name}.mode: '{mode}' would keep the worst '{metric}'; add {name}.mode={modes[metric]}"
            )
