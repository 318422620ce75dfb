"""A call's overrides, and what an evaluation makes of them and of its checkpoint's configuration."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from ljn.runs.checkpoints import Checkpoint, hash_of
from ljn.runs.files import write_atomically
from ljn.runs.keys import CONFIG_GROUPS, Key, key_of, kind_of

# A stored configuration is resolved: what was made of the body's group has to follow by hand.
_OF_BODY = {
    "body.path": ("data.body_path", "data.source.body_path", "module.body_path"),
    "body.genders": ("data.source.genders", "module.genders"),
    "body.predicted": ("module.predicted",),
}
_MISSING = object()
_WHOLE = {"data/sensor=": "data.sensor", "data/photo=": "data.photo", "data/source=": "data.source"}
"""Groups that an evaluation may choose as a whole, and the key that each sets."""


def typed_overrides() -> list[str]:
    """What was typed after `run.py`; nothing in a process that Hydra did not start."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def with_checkpoint_config(cfg: DictConfig, checkpoint: Checkpoint, overrides: list[str]) -> DictConfig:
    """The call's configuration with the checkpoint's model, data and trainer, and the overrides on top.

    Of the checkpoint's groups, the keys that `ljn.runs.keys` gives to the machine or the call have this call's values;
    with `data/sensor=NAME` or `data/photo=NAME` the data has that chain of steps, its cameras as they are; and with
    `data/source=NAME` its poses, or images, are those of another source. `data=NAME` may name the checkpoint's own kind
    of data, so that keys that only this kind has can be typed.

    Raises:
        FileNotFoundError: The detector of a checkpoint that carries none has gone.
        ValueError: An override is about something that the checkpoint decides.
    """
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=False)  # type: ignore[assignment]
    is_same_kind = plain["data"].get("_target_") == checkpoint.config["data"].get("_target_")
    new = _newer_keys(plain["data"], checkpoint.config["data"]) if is_same_kind else {}
    plain |= {name: _with_call(checkpoint.config[name], plain[name], name) for name in CONFIG_GROUPS}
    plain["data"] |= new
    merged = OmegaConf.create(plain)
    OmegaConf.set_struct(merged, True)
    for start, key in _WHOLE.items():
        if any(line.startswith(start) for line in overrides):
            OmegaConf.update(merged, key, OmegaConf.select(cfg, key), merge=False, force_add=True)
    done = (*_WHOLE, "data=") if is_same_kind else tuple(_WHOLE)
    apply_overrides(merged, [line for line in overrides if not line.startswith(done)])
    _find_detector(merged, checkpoint)
    return merged


def _newer_keys(call: Mapping[str, Any], stored: Mapping[str, Any]) -> dict[str, None]:
    """The keys that data of a checkpoint's kind did not have yet when it was trained: null, which changes nothing."""
    decides = Key.RUN | Key.THROUGH
    return {key: None for key in call if key not in stored and kind_of(f"data.{key}") & decides}


def _find_detector(cfg: DictConfig, checkpoint: Checkpoint) -> None:
    """Name the detector that a checkpoint carries in place of its file, where that has gone or is another one now."""
    path = OmegaConf.select(cfg, "data.detector_ckpt")
    if path is None or path != checkpoint.config["data"].get("detector_ckpt"):
        return
    file, name = Path(path), "" if checkpoint.detector is None else hash_of(checkpoint.detector)
    if checkpoint.detector is None:
        if not file.is_file():
            raise FileNotFoundError(
                f"data.detector_ckpt: no file '{path}', the detector whose joints '{checkpoint.path}' was trained on; "
                "name its place with data.detector_ckpt=FILE, or test on the data's own joints with "
                "data.detector_ckpt=null"
            )
    elif not file.is_file() or hash_of(file.read_bytes()) != name:
        carried = Path(cfg.paths.cache_dir) / "detectors" / f"{name}{file.suffix}"
        carried.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(carried, checkpoint.detector)
        cfg.data.detector_ckpt = str(carried)


def _with_call(stored: Any, call: Any, key: str) -> Any:
    """A checkpoint's values, with those of this call in its keys that are from a call."""
    if not (isinstance(stored, Mapping) and isinstance(call, Mapping)):
        return call if kind_of(key).is_from_call else stored
    return {
        name: _with_call(value, call[name], f"{key}.{name}") if name in call else value
        for name, value in stored.items()
    }


def apply_overrides(cfg: DictConfig, overrides: list[str]) -> None:
    """Change single values of data, trainer and body in a resolved configuration, a checkpoint's or part of one.

    Overrides that the checkpoint does not decide about are left out.

    Raises:
        ValueError: An override is about something that the checkpoint decides, or names no value.
    """
    for override in OverridesParser.create().parse_overrides(overrides):
        line = override.input_line or ""
        key = key_of(line)
        kind = kind_of(key)
        is_value = "/" not in override.key_or_group and not (override.is_delete() or override.is_add())
        if Key.CHANGEABLE in kind and "." in key and is_value:
            _set(cfg, key, override.value(), line)
        elif not kind.is_from_call:
            raise ValueError(
                f"{line}: model, data and sizes come from the checkpoint; an evaluation can change single values of "
                "data, trainer and body (data.synthesis.keypoint_noise_px=15) and choose callbacks, logger and paths"
            )


def _set(cfg: DictConfig, key: str, value: Any, line: str) -> None:
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
    mixed = OmegaConf.select(cfg, "data.source.sources", default={}) if key == "body.genders" else {}
    for derived in (*_OF_BODY.get(key, ()), *(f"data.source.sources.{name}.genders" for name in mixed)):
        if OmegaConf.select(cfg, derived, default=_MISSING) is not _MISSING:
            OmegaConf.update(cfg, derived, value)


def check_bodies(checkpoint: Checkpoint, hashes: set[str]) -> None:
    """Raise a `ValueError` unless a checkpoint was trained with the bodies of these hashes."""
    if unknown := checkpoint.unknown_bodies(hashes):
        raise ValueError(
            f"body: the checkpoint was trained with the bodies {checkpoint.body_hash}; {unknown[0]} is not among "
            "them. A model is only meaningful with its bodies: name them with body.path=FILE_OR_FOLDER and "
            "body.genders"
        )
