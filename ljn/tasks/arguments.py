"""The command line before Hydra reads it: paths that its grammar would take apart, keys that have moved."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from hydra.core.override_parser.types import Quote, QuotedString

_OF_PREDICT = ("input", "camera", "keypoints", "mask", "mesh_ckpt_path")
_PATHS = (
    *(f"task.{name}" for name in (*_OF_PREDICT, "directory")),
    *("ckpt_path", "paths.output_dir", "paths.cache_dir", "body.path", "data.source.path"),
    *("data.source.split_path", "data.detector_ckpt"),
)
# What is no bare path: nothing, quoted, a list, an interpolation, or several values of a sweep.
_NOT_BARE = re.compile(r"""$|null$|['"\[]|.*\$\{|.*,|(choice|glob|tag)\(""")


def prepare_arguments(arguments: Sequence[str]) -> list[str]:
    """A command line's arguments with every path in quotes, as Hydra needs it for `2023_04_01` or `a=b`.

    Paths that begin with `~` are those of the user's home.

    Raises:
        ValueError: A key of `task=predict` is without its `task.`.
    """
    return [_prepare(argument) for argument in arguments]


def _prepare(argument: str) -> str:
    key, equals, value = argument.partition("=")
    if key in _OF_PREDICT and equals:
        raise ValueError(f"{key}: it is a key of the task; write task=predict task.{argument}")
    path = os.path.expanduser(value)
    if key not in _PATHS or (_NOT_BARE.match(value) and not os.path.exists(path)):
        return argument
    return f"{key}={quoted(path)}"


def quoted(path: str | Path) -> str:
    """A path as a value of an override, in quotes, so that Hydra's grammar leaves it as it is."""
    return QuotedString(str(path), Quote.single).with_quotes()
