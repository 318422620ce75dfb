"""Thousands of mutated files: nothing but the library's own errors comes out, and each names its file."""

import io
from collections import Counter

import numpy as np
import pytest
import scipy.io

from datamodules.sources.surreal.files import read_clip, read_filmed_clip, read_images
from tests.datamodules.surreal.writer import make_clip, write_mat73

NUM_MUTANTS = 3000
NUM_OF_HDF5 = 1500


def mutated(content, rng):
    """A file's bytes with some changed, cut off, doubled or filled."""
    data = bytearray(content)
    kind = rng.integers(6)
    start, stop = np.sort(rng.integers(len(data), size=2))
    if kind == 0:  # single bytes, most often in the first thousand, where the headers are
        for place in rng.integers(
            min(len(data), rng.choice([200, 1000, len(data)])), size=rng.integers(1, 8)
        ):
            data[place] = rng.integers(256)
    elif kind == 1:
        del data[start:]
    elif kind == 2:
        del data[start : min(stop, start + 64)]
    elif kind == 3:
        data[start:start] = data[start : min(stop, start + 64)]
    elif kind == 4:
        data[start : start + 8] = rng.choice([b"\x00" * 8, b"\xff" * 8, b"\x7f\xff\xff\xff" * 2])
    else:
        for place in rng.integers(len(data), size=rng.integers(1, 4)):
            data[place] ^= 1 << int(rng.integers(8))
    return bytes(data)


def fuzz(contents, readers, path, number):
    """How many mutants were read, and how many refused; both say what they were."""
    rng = np.random.default_rng(0)
    counts, unnamed = Counter(), 0
    for turn in range(number):
        which = turn % len(contents)
        path.write_bytes(mutated(contents[which], rng))
        for read in readers[which]:
            try:
                clip = read(path)
            except ValueError as error:
                counts["refused"] += 1
                unnamed += path.name not in str(error)
            else:
                counts["read"] += 1
                assert isinstance(clip, list) or len(clip) == len(clip.is_good) == len(clip.gender)
    assert unnamed == 0
    return counts


def mat(fields, compressed):
    file = io.BytesIO()
    scipy.io.savemat(file, fields, do_compression=compressed)
    return file.getvalue()


@pytest.mark.slow
def test_mutants_of_matlabs_files_are_read_or_refused(tmp_path, capsys):
    contents = [
        mat(make_clip(seed, frames)[0], compressed)
        for seed, frames, compressed in ((0, 1, False), (1, 2, True))
    ]
    contents.append(mat({"depth_1": np.ones((240, 320), np.float32)}, True))
    readers = [(read_clip, read_filmed_clip)] * 2 + [(lambda path: read_images(path, "depth", [0]),)]
    counts = fuzz(contents, readers, tmp_path / "a_info.mat", NUM_MUTANTS)
    with capsys.disabled():
        print(f"\nMATLAB 5: {NUM_MUTANTS} mutants, {dict(counts)}")
    assert min(counts["read"], counts["refused"]) > NUM_MUTANTS / 10


@pytest.mark.slow
def test_mutants_of_hdf5_files_are_read_or_refused(tmp_path, capsys, h5py):
    path = tmp_path / "a_info.mat"
    write_mat73(path, make_clip(0, 2)[0], h5py, cells=("gender",))
    counts = fuzz([path.read_bytes()], [(read_clip,)], path, NUM_OF_HDF5)
    with capsys.disabled():
        print(f"\nMATLAB 7.3: {NUM_OF_HDF5} mutants, {dict(counts)}")
    assert min(counts["read"], counts["refused"]) > NUM_OF_HDF5 / 20
