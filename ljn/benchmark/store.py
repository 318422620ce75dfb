"""Results on disk as they come, by the hash of all that they depend on: what is there is not measured again."""

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ljn.reading import READ_ERRORS, read_arrays
from ljn.runs.files import write_atomically


class Store:
    """Arrays by name under plain values that identify them.

    Args:
        directory: Where they lie.
        reads: Whether what is there is used; else it is measured and written anew.
    """

    def __init__(self, directory: Path, reads: bool = True) -> None:
        self.directory = directory
        self.reads = reads
        self._fresh: set[Path] = set()

    def get(self, identity: Mapping[str, Any], num_rows: int) -> dict[str, np.ndarray] | None:
        """The arrays' first `num_rows` rows; None where there are none, or fewer, or a damaged file."""
        path = self._path(identity)
        if not path.is_file() or not (self.reads or path in self._fresh):
            return None
        try:
            arrays = read_arrays(path)
        except READ_ERRORS:
            return None
        if not arrays or min(map(len, arrays.values())) < num_rows:
            return None
        return {name: values[:num_rows] for name, values in arrays.items()}

    def put(self, identity: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        """Write the arrays, whole or not at all."""
        self.directory.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **dict[str, Any](arrays))
        path = self._path(identity)
        write_atomically(path, buffer.getvalue())
        self._fresh.add(path)

    def _path(self, identity: Mapping[str, Any]) -> Path:
        return self.directory / f"{short_hash(identity)}.npz"


def short_hash(values: Any) -> str:
    """First 16 hex digits of the SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]
