"""Files of runs: named safely, written whole or not at all, read without trusting them."""

import json
import math
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ljn import reading
from ljn.runs import layout

_MAX_DEPTH = 32
_MAX_METRIC = 1e100


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all. NaN and infinity are written as null."""
    write_text_atomically(path, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def write_text_atomically(path: Path, text: str) -> None:
    """Write a text file; see `write_atomically`."""
    write_atomically(path, text.encode())


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file, whole or not at all: after a failure the old file is unchanged and no draft is left."""
    # Jobs side by side write the same files, each in a process of its own.
    draft = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        draft.write_bytes(data)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def path_part(text: str) -> str:
    """A name from a configuration or a file as one part of a path: never a way to another directory.

    Separators and control characters become "-", and so do dots at its beginning; what is left of a long name is
    its first 100 characters.
    """
    return re.sub(r"^\.+|[/\\\x00-\x1f\x7f]", "-", text)[:100] or "-"


def read_json(path: Path) -> dict[str, Any] | None:
    """The content of a JSON file, NaN and infinity as None; None where there is no file, or a damaged one.

    Damaged is what holds no object, is larger or deeper than any that is written here, or cannot be written again.
    """
    try:
        content = reading.read_json(path)
        _check(content)
    except reading.READ_ERRORS:
        return None
    return _finite(content) if isinstance(content, dict) else None


def read_metrics(directory: Path) -> dict[str, float] | None:
    """A run's metrics by name, NaN where one was not finite; None where there are none, or a damaged file."""
    content = read_json(directory / layout.METRICS)
    if content is None or any(type(value) not in (int, float, type(None)) for value in content.values()):
        return None
    # What no network predicts would overflow in a mean.
    return {
        name: math.nan if value is None or abs(value) > _MAX_METRIC else float(value)
        for name, value in content.items()
    }


def _check(value: Any, depth: int = 0) -> None:
    """Raise a `ValueError` for plain values that are nested too deeply, or text with half a surrogate pair."""
    if depth > _MAX_DEPTH:
        raise ValueError("nested too deeply")
    if isinstance(value, str):
        value.encode()
    elif isinstance(value, dict):
        _check([*value, *value.values()], depth)
    elif isinstance(value, list):
        for entry in value:
            _check(entry, depth + 1)


def _finite(value: Any) -> Any:
    return map_floats(value, lambda number: number if math.isfinite(number) else None)


def map_floats(value: Any, function: Callable[[float], Any]) -> Any:
    """Plain values with `function` applied to every float in them."""
    if isinstance(value, float):
        return function(value)
    if isinstance(value, Mapping):
        return {key: map_floats(entry, function) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [map_floats(entry, function) for entry in value]
    return value
