import zlib
from pathlib import Path

import numpy as np
import pytest

from ljn.body import load_body_models
from tests.datamodules.surreal.writer import clip_path, write_clip, write_mat


@pytest.fixture(scope="session")
def h5py():
    return pytest.importorskip("h5py", reason="h5py is not installed: pip install -e '.[hdf5]'")


@pytest.fixture(scope="session")
def surreal_bodies():
    """The bodies that the files are written from."""
    return load_body_models(None, ["female", "male"])


def plain_fields(seed=0, num_frames=8):
    """What a source of poses reads of a clip, of no body in particular."""
    rng = np.random.default_rng(seed)
    return {
        "pose": rng.standard_normal((72, num_frames)).astype(np.float32),
        "shape": np.tile(rng.standard_normal((10, 1)), num_frames),
        "gender": np.full((num_frames, 1), rng.integers(2), np.uint8),
    }


def write_plain(root, split, sequence, number=1, num_frames=8, run="run0", **changes):
    """Write a clip without joints; its fields."""
    fields = plain_fields(zlib.crc32(f"{sequence} {number}".encode()), num_frames) | changes
    stem = clip_path(root, split, sequence, number, run)
    write_mat(Path(f"{stem}_info.mat"), fields)
    return fields


@pytest.fixture(scope="session")
def filmed_tree(tmp_path_factory):
    """A tree of four clips of training, test and validation; of test with images, radial."""
    root = tmp_path_factory.mktemp("filmed")
    for number, (split, sequence) in enumerate(
        [("train", "01_01"), ("test", "02_01"), ("test", "ung_03_02"), ("val", "02_01")]
    ):
        write_clip(root, split, sequence, images=split == "test", seed=number, num_frames=6, distance=5.0)
    return root
