"""Thousands of mutated files: nothing but the library's own errors comes out, soon, and each names its file."""

import io
import struct
import time
import zlib
from collections import Counter

import numpy as np
import pytest
import scipy.io

from datamodules.sources.surreal.files import read_clip, read_filmed_clip, read_images
from tests.datamodules.surreal.writer import make_clip, write_mat73

NUM_MUTANTS = 3000
NUM_OF_PARTS = 6000
NUM_OF_HDF5 = 2000
NUM_OF_NODES = 1000
LONGEST_S = 3  # on a busy machine; most take a millisecond


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


def parts_of(matrix):
    """Where an array's flags, dimensions, name and numbers begin."""
    places = [8, 24]
    for _ in range(2):
        word, size = struct.unpack_from("<II", matrix, places[-1])
        places.append(places[-1] + (8 if word >> 16 else 8 + -(-size // 8) * 8))
    return places


def changed(matrix, other, rng):
    """An array of MATLAB 5 that says something else than it should."""
    data, places = bytearray(matrix), parts_of(matrix)
    number = int(rng.choice([0, 1, 2, 3, 7, 72, 255, 65536, 2**31 - 1, 2**31, 2**32 - 1]))
    kind = rng.integers(7)
    if kind == 0:  # the kind or the size of it, or of a part
        number = number if rng.random() < 0.5 else int(rng.integers(20))
        struct.pack_into("<I", data, int(rng.choice([0, *places])) + 4 * int(rng.integers(2)), number)
    elif kind == 1:  # its class
        struct.pack_into("<I", data, 16, int(rng.integers(20)) | int(rng.choice([0, 0x200, 0x800])))
    elif kind == 2:
        struct.pack_into("<I", data, 32 + 4 * int(rng.integers(2)), number)  # a dimension
    elif kind == 3:
        value = np.float32(rng.choice([np.nan, np.inf, -1e30, 3.0])).tobytes()
        for place in rng.integers(places[3] + 8, len(data) - 4, 3) if len(data) > places[3] + 12 else ():
            data[place : place + 4] = value
    elif kind == 4:
        data[places[3] :] = other[parts_of(other)[3] :]  # another's numbers
    elif kind == 5:
        del data[int(rng.integers(len(data))) :]
    else:
        data[:] = tagged(15, zlib.compress(matrix))  # which is packed once more, half of the time
    return bytes(data)


def tagged(kind, content):
    return struct.pack("<II", kind, len(content)) + content


def with_other_parts(content, rng):
    """A file of MATLAB 5 to 7 whose pieces, and their checksums, are whole; some are changed, and half are packed."""
    matrices, place = [], 128
    while place < len(content):
        stop = place + 8 + struct.unpack_from("<I", content, place + 4)[0]
        matrices.append(content[place:stop])
        place = stop
    whole = list(matrices)
    for which in rng.permutation(len(whole))[: rng.integers(1, 4)]:
        matrices[which] = changed(whole[which], whole[rng.integers(len(whole))], rng)
    matrices = [tagged(15, zlib.compress(each, 1)) if rng.random() < 0.5 else each for each in matrices]
    if rng.random() < 0.1:
        matrices.append(whole[rng.integers(len(whole))])
        del matrices[rng.integers(len(matrices))]
    return content[:128] + b"".join(matrices)


def fuzz(contents, readers, path, number, mutate=mutated):
    """How many mutants were read, how many refused, and the longest time that one took."""
    rng = np.random.default_rng(0)
    counts, unnamed, longest = Counter(), 0, 0.0
    for turn in range(number):
        which = turn % len(contents)
        path.write_bytes(mutate(contents[which], rng))
        for read in readers[which]:
            start = time.perf_counter()
            try:
                clip = read(path)
            except ValueError as error:
                counts["refused"] += 1
                unnamed += path.name not in str(error)
            else:
                counts["read"] += 1
                assert isinstance(clip, list) or len(clip) == len(clip.is_good) == len(clip.gender)
            longest = max(longest, time.perf_counter() - start)
    assert unnamed == 0
    assert longest < LONGEST_S
    return dict(counts) | {"longest, s": round(longest, 3)}


def plain(fields):
    """The fields that hold numbers."""
    return {name: value for name, value in fields.items() if np.asarray(value).dtype.kind in "fu"}


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
        print(f"\nMATLAB 5: {NUM_MUTANTS} mutants, {counts}")
    assert min(counts["read"], counts["refused"]) > NUM_MUTANTS / 10


@pytest.mark.slow
def test_mutants_whose_checksums_are_right_are_read_or_refused(tmp_path, capsys):
    contents = [mat(plain(make_clip(seed, frames)[0]), False) for seed, frames in ((0, 1), (1, 2))]
    contents.append(mat({"depth_1": np.ones((240, 320), np.float32)}, False))
    readers = [(read_clip, read_filmed_clip)] * 2 + [(lambda path: read_images(path, "depth", [0]),)]
    counts = fuzz(contents, readers, tmp_path / "a_info.mat", NUM_OF_PARTS, with_other_parts)
    with capsys.disabled():
        print(f"\nMATLAB 5, whole pieces: {NUM_OF_PARTS} mutants, {counts}")
    assert min(counts["read"], counts["refused"]) > NUM_OF_PARTS / 10


@pytest.mark.slow
def test_mutants_of_hdf5_files_are_read_or_refused(tmp_path, capsys, h5py):
    path = tmp_path / "a_info.mat"
    write_mat73(path, make_clip(0, 2)[0], h5py, cells=("gender",))
    counts = fuzz([path.read_bytes()], [(read_clip,)], path, NUM_OF_HDF5)
    with capsys.disabled():
        print(f"\nMATLAB 7.3: {NUM_OF_HDF5} mutants, {counts}")
    assert min(counts["read"], counts["refused"]) > NUM_OF_HDF5 / 20


def add_another_node(file, name, h5py, rng):
    """A data set that MATLAB would not write, or not for a clip."""
    frames = int(rng.choice([0, 1, 2, 8, 2**40]))
    shape = ((frames, 72), (frames,), (72, frames), (3, 24, 8), ())[rng.integers(5)]
    kinds = ("f2", "f4", ">f8", "u1", "i8", "?", "c8", "S4", "V3", [("a", "f4")], ("f4", (72,)), h5py.vlen_dtype("f4"),
             h5py.ref_dtype, h5py.regionref_dtype, h5py.string_dtype())  # fmt: skip
    turn = rng.integers(7)
    if turn == 0:
        file.create_group(name)["data"] = np.ones(3)
    elif turn == 1:
        file[name] = (h5py.SoftLink(f"/{name}"), h5py.SoftLink("/none"), np.dtype("f4"))[rng.integers(3)]
    elif turn == 2:
        cell = file.create_dataset(name, (int(rng.choice([0, 1, 5])), 1), h5py.ref_dtype)
        if cell.size:
            cell[0, 0] = (cell.ref, file.ref)[rng.integers(2)]
    elif turn == 3:
        file.create_dataset(name, data=h5py.Empty("f4"))
    else:
        is_huge = frames > 2**30 and shape
        kind = kinds[rng.integers(len(kinds))]
        # Of a huge one no piece is there.
        node = file.create_dataset(name, shape, np.dtype(kind), chunks=(1,) * len(shape) if is_huge else None)
        texts = (b"char", "single", 5, np.arange(3), b"\xff")
        for attribute in ("MATLAB_class", "MATLAB_empty"):
            if rng.random() < 0.3:
                node.attrs[attribute] = texts[rng.integers(5)]


@pytest.mark.slow
def test_hdf5_files_with_other_nodes_are_read_or_refused(tmp_path, capsys, h5py):
    path = tmp_path / "a_info.mat"
    write_mat73(path, make_clip(0, 8)[0], h5py)
    whole = path.read_bytes()

    def mutate(content, rng):
        path.write_bytes(content)
        with h5py.File(path, "r+") as file:
            name = ("pose", "shape", "gender")[rng.integers(3)]
            del file[name]
            add_another_node(file, name, h5py, rng)
        return path.read_bytes()

    counts = fuzz([whole], [(read_clip,)], path, NUM_OF_NODES, mutate)
    with capsys.disabled():
        print(f"\nMATLAB 7.3, other nodes: {NUM_OF_NODES} mutants, {counts}")
    assert counts["refused"] > NUM_OF_NODES / 2
