"""Fixed sets of samples, and tables of poses, on disk: made once, shared by every run that asks for the same ones."""

import json
import os
import shutil
import uuid
import warnings
import zlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from datamodules.sources import PoseRecords
from ljn.reading import READ_ERRORS, read_json, reason


def cached_samples(directory: Path, key: str, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """The samples stored in `directory` under `key`, made and stored first where they are missing.

    The key is a hash of all that the samples depend on; these are tensors with the same first dimension, backed by the
    files and read when they are touched.

    A set is written beside its place and then renamed into it: it is there whole or not at all, also when two
    processes make it at once (the second one's copy is dropped). A damaged set is made anew, with a warning.
    """
    place = directory / key
    if place.is_dir():
        try:
            return _read(place)
        except READ_ERRORS as error:
            warnings.warn(
                f"samples in {place} are damaged or of an older form ({reason(error)}); making them anew",
                stacklevel=2,
            )
            shutil.rmtree(place, ignore_errors=True)
    draft = directory / f"{key}.{os.getpid()}.{uuid.uuid4().hex[:8]}.tmp"
    draft.mkdir(parents=True)  # before the samples are made: it may not be possible
    try:
        samples = make()
        for name, value in samples.items():
            np.save(draft / f"{name}.npy", value.numpy(), allow_pickle=False)
        index = {"names": list(samples), "checksum": _checksum(draft, samples)}
        (draft / "index.json").write_text(json.dumps(index))
        try:
            draft.rename(place)
        except OSError:
            if not place.is_dir():
                raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return _read(place)


def cached_records(directory: Path, key: str, make: Callable[[], PoseRecords]) -> PoseRecords:
    """The records stored in `directory` under `key`, made and stored first where they are missing.

    As `cached_samples`: a key says all that they depend on, and arrays are read when they are touched.
    """

    def columns() -> dict[str, Tensor]:
        records = make()
        # Text of one length, as its characters' numbers.
        letters = np.ascontiguousarray(records.sequence).view(np.int32).reshape(len(records), -1)
        numbers = {
            "pose": records.pose,
            "betas": records.betas,
            "gender": records.gender,
            "frame": records.frame,
        }
        return {
            **{name: torch.from_numpy(column) for name, column in numbers.items()},
            "sequence": torch.from_numpy(letters),
            "has_heading": torch.full((len(records),), records.has_heading),
        }

    stored = {name: column.numpy() for name, column in cached_samples(directory, key, columns).items()}
    letters, has_heading = stored.pop("sequence"), stored.pop("has_heading")
    sequence = letters.view(f"<U{letters.shape[1]}").reshape(-1)
    return PoseRecords(**stored, sequence=sequence, has_heading=bool(has_heading.all()))


def _read(place: Path) -> dict[str, Tensor]:
    index = read_json(place / "index.json")
    if not index["names"] or index["checksum"] != _checksum(place, index["names"]):
        raise ValueError("other arrays than its index names")
    # Copy on write: torch wants writable memory, and nobody else may see a change.
    return {
        name: torch.from_numpy(np.load(place / f"{name}.npy", mmap_mode="c", allow_pickle=False))
        for name in index["names"]
    }


def _checksum(place: Path, names: Iterable[str]) -> int:
    """Of the names and the whole files of arrays: CRC-32, some 2 GB a second, where SHA-256 and BLAKE2 take longer."""
    checksum = 0
    for name in names:
        checksum = zlib.crc32(name.encode(), checksum)
        with (place / f"{name}.npy").open("rb") as file:
            while chunk := file.read(2**20):
                checksum = zlib.crc32(chunk, checksum)
    return checksum
