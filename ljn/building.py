"""From configuration to objects, and to nothing but an allow-list of classes.

A `_target_` names code, and a configuration may come out of a checkpoint from anywhere.
"""

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from ljn.reading import brief, reason

OWN_MODULES = (
    "ljn.nets.", "ljn.modules.", "ljn.geometry.camera.", "ljn.cloud.observation.", "ljn.cloud.rgb.",
    "ljn.benchmark.", "datamodules.", "callbacks.",
)  # fmt: skip
"""The modules whose classes a config may name."""
_FOREIGN_BASES = {
    "lightning.pytorch.": ("Trainer", "Callback", "loggers.Logger"),
    "torch.optim.": ("Optimizer", "lr_scheduler.LRScheduler"),
}
"""Of other modules, the classes that a config may name, with what they inherit."""
_ALLOWED = (*OWN_MODULES, *_FOREIGN_BASES)


MOVED: dict[str, str] = {}
"""Where a class that a config may name was once, and where it is now: what was trained outlives a move."""


def with_moved_targets(config: Any) -> Any:
    """A plain config with every `_target_` that has moved (see `MOVED`) under its new import path."""
    if isinstance(config, Mapping):
        moved = {key: with_moved_targets(value) for key, value in config.items()}
        target = moved.get("_target_")
        return moved | {"_target_": MOVED[target]} if isinstance(target, str) and target in MOVED else moved
    if isinstance(config, list):
        return [with_moved_targets(value) for value in config]
    return config


def check_targets(config: Any, where: str = "") -> None:
    """Raise a `ValueError` if any `_target_` in a plain config names something outside the allow-list.

    The object that a name leads to is checked, not the name alone: `ljn.nets.layers.math.os` is refused, and so is a
    function that calls its arguments, such as Lightning's `instantiate_class`.
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
    allowed = ", ".join(_ALLOWED)
    where, named = brief(where), f"`_target_: {brief(target)}`"
    if not target.startswith(_ALLOWED):
        raise ValueError(f"{where}: {named} is outside the modules that a config may name: {allowed}")
    try:
        target_class = _find(target)
    except (ImportError, AttributeError, ValueError) as error:  # a name with an empty part
        raise ValueError(f"{where}: {named} cannot be found ({reason(error)})") from error
    home = f"{getattr(target_class, '__module__', None)}."
    if not isinstance(target_class, type) or not home.startswith(_ALLOWED):
        raise ValueError(
            f"{where}: {named} leads to {type(target_class).__name__} of {home.rstrip('.')}; a config may name "
            f"classes of {allowed}"
        )
    for prefix, bases in _FOREIGN_BASES.items():
        if home.startswith(prefix) and not issubclass(
            target_class, tuple(_find(prefix + base) for base in bases)
        ):
            raise ValueError(
                f"{where}: {named} is none of the classes that a config may name of "
                f"{prefix.rstrip('.')}: those that inherit {' or '.join(bases)}"
            )


def _find(path: str) -> Any:
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


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
        raise ValueError(reason(error, 1000)) from error


def build_foreign(config: Mapping[str, Any], where: str) -> Any:
    """The object of a plain node that was typed in a call: of any class, since it is the user's own code.

    Never for a node of a file from elsewhere, such as a checkpoint's. Errors begin with `where`.

    Raises:
        ValueError: There is no such class, or it does not take these arguments, or refuses them.
        FileNotFoundError: It misses a file.
    """
    try:
        return hydra.utils.instantiate({"_convert_": "all", **config})
    except hydra.errors.InstantiationException as error:
        if isinstance(error.__cause__, FileNotFoundError):
            raise error.__cause__ from None
        raise ValueError(f"{where}: {reason(error.__cause__ or error, 1000)}") from error


def build_each(configs: DictConfig | None) -> list[Any]:
    """The objects of a mapping of config nodes (callbacks, loggers); those set to null are left out."""
    return [build(node) for node in (configs or {}).values() if node is not None]
