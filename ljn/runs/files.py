"""Files of runs: named safely, written whole or not at all, read without trusting them."""

import json
import math
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all. NaN and infinity are written as null."""
    write_text_atomically(path, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def write_text_atomically(path: Path, text: str) -> None:
    """Write a text file, whole or not at all: after a failure the old one is there, and nothing beside it."""
    # Jobs side by side write the same files, each in a process of its own.
    draft = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        draft.write_text(text, encoding="utf-8")
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
    """The content of a JSON file; None where there is none, or a damaged one."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


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
