"""From configuration to objects, and from nothing but an allow-list of modules.

A `_target_` names code, and a configuration may come out of a checkpoint from anywhere.
"""

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

ALLOWED_MODULES = (
    "ljn.",
    "datamodules.",
    "callbacks.",
    "lightning.pytorch.",
    "torch.optim.",
)


def check_targets(config: Any, where: str = "") -> None:
    """Raise a `ValueError` if any `_target_` in a plain config names something outside the allow-list.

    What a name leads to counts, not the name alone: `ljn.x.os.system` is no way out.
    """
    if isinstance(config, Mapping):
        if "_target_" in config:
            _check_target(str(config["_target_"]), where or "the config")
        for key, value in config.items():
            check_targets(value, f"{where}.{key}".lstrip("."))
    elif isinstance(config, Sequence) and not isinstance(config, str):
        for number, value in enumerate(config):
            check_targets(value, f"{where}[{number}]")


def _check_target(target: str, where: str) -> None:
    allowed = ", ".join(ALLOWED_MODULES)
    if not target.startswith(ALLOWED_MODULES):
        raise ValueError(
            f"{where}: `_target_: {target}` is outside the modules that a config may name: {allowed}"
        )
    module, _, name = target.rpartition(".")
    try:
        found = getattr(import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{where}: `_target_: {target}` cannot be found ({error})") from error
    home = f"{getattr(found, '__module__', None)}."
    if not callable(found) or not home.startswith(ALLOWED_MODULES):
        raise ValueError(
            f"{where}: `_target_: {target}` leads to {home.rstrip('.')}, outside the modules that a config may "
            f"name: {allowed}"
        )


def build(config: DictConfig | Mapping[str, Any], **arguments: Any) -> Any:
    """The object that a config node, or a plain one, describes; `arguments` are added to the node's own.

    Raises:
        ValueError: A `_target_` outside the allow-list, or arguments that the target does not take.
    """
    check_targets(OmegaConf.to_container(config, resolve=True) if OmegaConf.is_config(config) else config)
    try:
        return hydra.utils.instantiate(config, **arguments)
    except hydra.errors.InstantiationException as error:
        # The cause says what is wrong; Hydra's wrapper would hide its type from callers and users.
        if isinstance(error.__cause__, ValueError | FileNotFoundError | ImportError):
            raise error.__cause__ from None
        raise ValueError(str(error)) from error


def build_each(configs: DictConfig | None) -> list[Any]:
    """The objects of a mapping of config nodes (callbacks, loggers); those set to null are left out."""
    return [build(node) for node in (configs or {}).values() if node is not None]
