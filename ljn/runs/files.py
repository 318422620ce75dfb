"""JSON files of runs: written whole or not at all, read without trusting them."""

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all. NaN and infinity are written as null."""
    draft = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    draft.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")
    draft.replace(path)


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
