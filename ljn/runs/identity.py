"""A run's identity: the hash of everything that its numbers depend on, which names its directory.

The same command finds the run again: to resume it, to skip it, or to share it.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict

from ljn.runs.files import map_floats

# What may differ between two runs that are the same run; what data files hold is in the data's fingerprint.
_NOT_IDENTITY: dict[str, tuple[str, ...]] = {
    "data": ("source", "cache_dir", "num_workers", "prefetch_batches", "body_path", "detector_ckpt"),
    "module": ("body_path",),
    "callbacks": ("progress", "errors", "pictures"),
    "trainer": (
        "accelerator",
        "devices",
        "strategy",
        "enable_model_summary",
        "log_every_n_steps",
        "profiler",
    ),
}


def identity(cfg: DictConfig, data_fingerprint: str) -> dict[str, Any]:
    """Everything that a run's numbers depend on, as plain values.

    Args:
        cfg: The composed configuration.
        data_fingerprint: See `BodyDataModule.fingerprint`.
    """
    cfg = cfg.copy()
    with open_dict(cfg):
        cfg.paths.run_dir = ""  # named by what comes of this
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    kept: dict[str, Any] = {"seed": plain["seed"], "data_fingerprint": data_fingerprint}
    kept |= {"predicted_body": predicted_body(cfg)}
    # Callbacks: what chooses the best epoch, or ends a training.
    for group in ("data", "model", "module", "trainer", "callbacks"):
        dropped = _NOT_IDENTITY.get(group, ())
        content = plain[group] or {}
        kept[group] = {
            key: value for key, value in content.items() if key not in dropped and value is not None
        }
    return kept


def predicted_body(cfg: DictConfig) -> str | None:
    """Hash of the body that a mesh regressor's meshes are of; None for a detector."""
    if "predicted" not in cfg.module:
        return None
    from ljn.body import load_body_models  # and with it PyTorch, which a sweep's report does not need

    [body] = load_body_models(cfg.module.body_path, [cfg.module.predicted])
    return body.hash


def config_hash(plain: Mapping[str, Any]) -> str:
    """First 8 hex digits of the SHA-256 of plain values, whatever the order of their keys; 10 and 10.0 agree."""
    return hashlib.sha256(json.dumps(_canonical(plain), sort_keys=True).encode()).hexdigest()[:8]


def _canonical(value: Any) -> Any:
    return map_floats(value, lambda number: int(number) if number.is_integer() else number)
