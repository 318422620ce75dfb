"""What types alone cannot say about a configuration, checked before data is read or a model is built."""

import tempfile
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ljn.body.skeleton import JOINT_NAMES, NUM_JOINTS
from ljn.tasks.building import check_targets

_MULTI_PROCESS = ("ddp", "fsdp", "deepspeed")


def validate(cfg: DictConfig, is_multirun: bool = False) -> None:
    """Raise a `ValueError` that names the key, what was expected, what came and the fix."""
    try:
        plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
    except OmegaConfBaseException as error:
        raise ValueError(f"config: {error}".split("\n")[0]) from error
    check_targets(plain)
    _check_radii(plain.get("model") or {})
    _check_positive(plain)
    _check_monitors(plain)
    trainer = plain["trainer"]
    strategy = str(trainer.get("strategy") or "")
    devices = trainer.get("devices")
    if is_multirun and (strategy.startswith(_MULTI_PROCESS) or (isinstance(devices, int) and devices > 1)):
        raise ValueError(
            f"trainer: several processes (strategy='{strategy or 'auto'}', devices={devices}) do not go with "
            "a multirun, whose every child process would start the sweep again; use trainer.devices=1"
        )
    check_writable(Path(plain["paths"]["output_dir"]))


def check_writable(directory: Path) -> None:
    """Raise a `ValueError` unless files can be written in a directory, made where it is missing."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise ValueError(
            f"paths.output_dir: cannot write in '{directory}' ({error.strerror}); choose another one with "
            "paths.output_dir=DIRECTORY"
        ) from error


def _check_radii(model: dict[str, Any]) -> None:
    radii = model.get("radii_m")
    if radii is not None and len(radii) != NUM_JOINTS:
        raise ValueError(
            f"model.radii_m: expected {NUM_JOINTS} radii, one for each joint ({', '.join(JOINT_NAMES)}), got "
            f"{len(radii)}"
        )


def _check_positive(plain: dict[str, Any]) -> None:
    checked = {
        "data": ("num_points", "num_train", "num_val", "num_test", "batch_size"),
        "model": ("group_size",),
        "trainer": ("max_epochs",),
    }
    for group, keys in checked.items():
        for key in keys:
            value = (plain.get(group) or {}).get(key)
            if value is not None and not (isinstance(value, int) and value > 0):
                raise ValueError(f"{group}.{key}: expected a positive integer, got {value!r}")


def _check_monitors(plain: dict[str, Any]) -> None:
    from ljn.metrics import JointMetrics

    known = {f"val/{name}" for name in JointMetrics().keys(keep_base=True)} | {"train/loss"}
    for name, node in (plain.get("callbacks") or {}).items():
        monitor = (node or {}).get("monitor")
        if monitor is not None and monitor not in known:
            raise ValueError(
                f"callbacks.{name}.monitor: no metric '{monitor}' is logged in training; choose one of "
                f"{', '.join(sorted(known))}"
            )
