"""A run's identity: the hash of everything that its numbers depend on, which names its directory.

The same command finds the run again: to resume it, to skip it, or to share it.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict

from ljn.runs.files import map_floats
from ljn.runs.keys import Key, kind_of


def identity(cfg: DictConfig, data_fingerprint: str) -> dict[str, Any]:
    """Everything that a run's numbers depend on, as plain values: every key that `ljn.runs.keys` gives to the run.

    Nulls are left out at any depth, so that a key added later, null by default, changes no run's identity. The
    fingerprint is that of what the data's files hold, which their names do not say; see `DataModule`.
    """
    cfg = cfg.copy()
    with open_dict(cfg):
        cfg.paths.run_dir = ""  # its name depends on the identity
    values: dict[str, Any] = _of_run(OmegaConf.to_container(cfg, resolve=True))
    return values | {"data_fingerprint": data_fingerprint, "predicted_body": predicted_body(cfg)}


def _of_run(value: Any, key: str = "") -> Any:
    """The part of a value that belongs to the run's identity; None where nothing does."""
    if isinstance(value, Mapping):
        entries = {name: _of_run(entry, f"{key}.{name}".lstrip(".")) for name, entry in value.items()}
        return {name: entry for name, entry in entries.items() if entry not in (None, {})}
    if Key.RUN not in kind_of(key):
        return None
    # In a list every place counts.
    return [_of_run(entry, key) for entry in value] if isinstance(value, list) else value


def predicted_body(cfg: DictConfig) -> str | None:
    """Hash of the body that a mesh regressor's meshes are of; None for a detector."""
    if "predicted" not in cfg.module:
        return None
    from ljn.body import load_body_models  # and with it PyTorch, which a sweep's report does not need

    [body] = load_body_models(cfg.module.body_path, [cfg.module.predicted])
    return body.hash


def config_hash(plain: Mapping[str, Any]) -> str:
    """First 8 hex digits of the SHA-256 of plain values, independent of the keys' order; 10 and 10.0 agree."""
    canonical = map_floats(plain, lambda number: int(number) if number.is_integer() else number)
    return hashlib.sha256(json.dumps(canonical, sort_keys=True).encode()).hexdigest()[:8]
