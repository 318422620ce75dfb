"""The command line before Hydra reads it: paths that its grammar would take apart, short names of keys."""

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

    Paths that begin with `~` are those of the user's home. With `task=predict`, its keys may be typed without their
    `task.`, as in `input=DEPTH.png`.

    Raises:
        ValueError: A key of `task=predict` is given to another task.
    """
    return [_prepare(argument, "task=predict" in arguments) for argument in arguments]


def _prepare(argument: str, is_predict: bool) -> str:
    key, equals, value = argument.partition("=")
    if key in _OF_PREDICT and equals:
        if not is_predict:
            raise ValueError(f"{key}: only task=predict reads this; add task=predict, or leave it out")
        key = f"task.{key}"
        argument = f"{key}={value}"
    path = os.path.expanduser(value)
    if key not in _PATHS or (_NOT_BARE.match(value) and not os.path.exists(path)):
        return argument
    return f"{key}={quoted(path)}"


def quoted(path: str | Path) -> str:
    """A path as a value of an override, in quotes, so that Hydra's grammar leaves it as it is."""
    return QuotedString(str(path), Quote.single).with_quotes()
