"""The command line: before Hydra reads it, paths that its grammar would take apart and short names of keys; afterwards,
keys that the task would not see.
"""

import os
import re
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import DictConfig

from ljn.runs.keys import key_of

_SHORT = {
    **dict.fromkeys(("input", "camera"), ("task=predict", "task=ar")),
    **dict.fromkeys(("keypoints", "mask", "mask_id", "rgb"), ("task=predict",)),
    "strict": ("task=predict", "task=ar"),
    "keypoint_detector": ("task=predict", "task=ar", "task=package", "task=benchmark"),
    "mesh_ckpt_path": ("task=predict", "task=ar", "task=demo", "task=package", "task=benchmark"),
}
"""Keys of tasks that may be typed without their `task.`, and the tasks that they are of."""
_OF_TASKS = {
    "ckpt_path": "predict ar evaluate benchmark demo package train",
    "weights": "predict ar evaluate benchmark demo figures train",
    "refine": "predict ar evaluate benchmark demo cross train",
    "bench": "benchmark",
    "predictor": "benchmark",
    "recording": "ar",
    "segmentation": "ar",
}
"""Keys of the root, and the tasks that read them; a training, to refuse them."""
_PATHS = (
    *(f"task.{name}" for name in (*_SHORT, "directory") if name not in ("mask_id", "strict")),
    *("ckpt_path", "weights", "paths.output_dir", "paths.cache_dir", "body.path"),
    *("data.detector_ckpt", "data.keypoint_ckpt", "bench.path", "bench.samples.path"),
)
_OF_SOURCE = re.compile(r"data\.source\.(sources\.\w+\.)?(path|split_path|splits|skeleton)")
"""The paths of sources, also of those that are mixed."""
# What is no bare path: nothing, quoted, a list, an interpolation, or several values of a sweep.
_NOT_BARE = re.compile(r"""$|null$|['"\[]|.*\$\{|.*,|(choice|glob|tag)\(""")

_PLUGINS = {
    "hydra/launcher=parallel": ("hydra_joblib_launcher", "sweep"),
    "hydra/launcher=local": ("hydra_submitit_launcher", "sweep"),
    "hydra/launcher=slurm": ("hydra_submitit_launcher", "sweep"),
    "sweep=search": ("hydra_optuna_sweeper", "optuna"),
}
"""What of Hydra is no part of it: the plugin's module, and this project's extra that brings it."""


def prepare_arguments(arguments: Sequence[str]) -> list[str]:
    """A command line's arguments with every path in quotes, as Hydra needs it for `2023_04_01` or `a=b`.

    Paths that begin with `~` are those of the user's home. The keys of `task=predict` may be typed without their
    `task.`, as in `input=DEPTH.png`.

    Raises:
        ValueError: Such a key is given to another task.
        ImportError: A launcher or a sweeper is chosen whose package is missing.
    """
    for argument in arguments:
        if (plugin := _PLUGINS.get(argument)) and not _is_there(plugin[0]):
            raise ImportError(
                f"{argument}: it needs a package that is not installed: pip install -e '.[{plugin[1]}]'"
            )
    return [_prepare(argument, arguments) for argument in arguments]


def check_is_read(cfg: DictConfig) -> None:
    """Raise a `ValueError` for a key that was typed for a task which would not see it."""
    task = cfg.task._target_.rpartition(".")[2]
    for line in HydraConfig.get().overrides.task:
        key = key_of(line).partition(".")[0]
        readers = _OF_TASKS.get(key, task).split()
        if task not in readers and cfg[key] is not None:
            raise ValueError(
                f"{key}: task={task} does not read it; leave it out, or choose one of the tasks {', '.join(readers)}"
            )


def _is_there(plugin: str) -> bool:
    return find_spec("hydra_plugins") is not None and find_spec(f"hydra_plugins.{plugin}") is not None


def _prepare(argument: str, arguments: Sequence[str]) -> str:
    key, equals, value = argument.partition("=")
    if key in _SHORT and equals:
        tasks = _SHORT[key]
        if not set(tasks) & set(arguments):
            *first, last = tasks
            named = f"{', '.join(first)} and {last} read" if first else f"{last} reads"
            raise ValueError(f"{key}: only {named} this; add {tasks[0]}, or leave it out")
        key = f"task.{key}"
        argument = f"{key}={value}"
    path = os.path.expanduser(value)
    is_path = key in _PATHS or _OF_SOURCE.fullmatch(key)
    if not is_path or (_NOT_BARE.match(value) and not os.path.exists(path)):
        return argument
    return f"{key}={quoted(path)}"


def quoted(path: str | Path) -> str:
    """A path as a value of an override, in quotes, so that Hydra's grammar leaves it as it is."""
    return QuotedString(str(path), Quote.single).with_quotes()
