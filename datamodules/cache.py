"""Fixed sets of samples on disk: made once, shared by every run that asks for the same ones."""

import json
import os
import shutil
import uuid
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor


def cached_samples(directory: Path, key: str, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """The samples stored under `key`, made and stored first where they are missing.

    A set is written beside its place and then renamed into it: it is there whole or not at all, also when two
    processes make it at once (the second one's copy is dropped). A damaged set is made anew, with a warning.

    Args:
        directory: Where sets are kept.
        key: Hash of all that the samples depend on.
        make: Gives the samples: tensors with the same first dimension.

    Returns:
        Tensors backed by the files, read when they are touched.
    """
    place = directory / key
    if place.is_dir():
        try:
            return _read(place)
        except (OSError, ValueError, KeyError, EOFError) as error:
            warnings.warn(f"samples in {place} are damaged ({error}); making them anew", stacklevel=2)
            shutil.rmtree(place, ignore_errors=True)
    draft = directory / f"{key}.{os.getpid()}.{uuid.uuid4().hex[:8]}.tmp"
    draft.mkdir(parents=True)  # before the samples are made: it may not be possible
    try:
        samples = make()
        shapes = {}
        for name, value in samples.items():
            np.save(draft / f"{name}.npy", value.numpy(), allow_pickle=False)
            shapes[name] = list(value.shape)
        (draft / "index.json").write_text(json.dumps(shapes))
        try:
            draft.rename(place)
        except OSError:
            if not place.is_dir():
                raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return _read(place)


def _read(place: Path) -> dict[str, Tensor]:
    shapes = json.loads((place / "index.json").read_text())
    if not isinstance(shapes, dict) or not shapes:
        raise ValueError("index.json names no arrays")
    samples = {}
    for name, shape in shapes.items():
        # Copy on write: torch wants writable memory, and nobody else may see a change.
        array = np.load(place / f"{name}.npy", mmap_mode="c", allow_pickle=False)
        if list(array.shape) != shape:
            raise ValueError(f"{name}: expected shape {shape}, got {list(array.shape)}")
        samples[name] = torch.from_numpy(array)
    return samples
