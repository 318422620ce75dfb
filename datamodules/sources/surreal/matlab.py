"""MATLAB's files as data: arrays of numbers by name, of versions 5 to 7 and, through h5py, of 7.3, which is HDF5.

Nothing in a file is run, no other file is opened through it, and all that is wrong with one is a `ValueError`. Versions
5 to 7 are read here, since scipy's reader ends the whole process at some damaged files.
"""

import math
import os
import struct
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from ljn.optional import import_h5py
from ljn.reading import READ_ERRORS, brief, reason, shown

_HDF5 = b"\x89HDF\r\n\x1a\n"
_HDF5_PLACES = (512, 0)  # MATLAB writes a block of text of its own before it, others may not
_MAX_VALUES = 2**22  # a clip of 100 frames has 7,200 joint angles, an image 76,800 pixels
_MAX_CELLS_IN_CELLS = 3

# Of versions 5 to 7 ("MAT-File Format", The MathWorks).
_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_OTHER_CLASSES = {1: "a cell array", 2: "a structure", 3: "an object", 4: "text", 5: "a sparse matrix"}
_COMPLEX = 0x0800
_HEAD = 512  # bytes in which a matrix says its class, its dimensions and its name


def read_mat(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Those of the named arrays that a file has, with MATLAB's order of dimensions.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is damaged, no MATLAB file, or a named variable holds no numbers.
        ImportError: It is of version 7.3, and h5py is not installed.
    """
    with path.open("rb") as file:
        head = file.read(_HDF5_PLACES[0] + len(_HDF5))
        is_hdf5 = any(head[place : place + len(_HDF5)] == _HDF5 for place in _HDF5_PLACES)
        try:
            return _read_hdf5(path, names) if is_hdf5 else _read_older(file, names)
        except _NoNumbersError as error:
            raise ValueError(f"{path}: {error}") from error
        except READ_ERRORS as error:
            raise ValueError(
                f"{path}: cannot be read as a MATLAB file ({reason(error)}); copy it again"
            ) from error


class _NoNumbersError(Exception):
    """A variable is whole, but holds something else than numbers."""

    def __init__(self, name: str, what: str) -> None:
        super().__init__(f"{brief(name)}: expected numbers, got {what}")


class _Element(NamedTuple):
    """A piece of a file: what kind it is, where its content lies, and where the next piece does."""

    kind: int
    start: int
    size: int
    stop: int


def _read_older(file: IO[bytes], names: Collection[str]) -> dict[str, np.ndarray]:
    size = os.fstat(file.fileno()).st_size
    file.seek(0)
    header = file.read(_HEADER)
    order = {b"IM": "<", b"MI": ">"}.get(header[126:128], "")
    if not order or header[125 if order == "<" else 124] != 1:
        is_page = header.lstrip().startswith(b"<")
        raise ValueError(
            "it is a web page" if is_page else "it does not begin as one" if header else "it is empty"
        )
    found, place = {}, _HEADER
    while place < size:
        file.seek(place)
        element = _element(file.read(8), 0, order)
        if element.kind not in (_MATRIX, _COMPRESSED):  # zeros, where a download was not finished
            raise ValueError(f"a piece of kind {element.kind}, where an array was expected")
        start, stop = place + element.start, place + element.start + element.size
        if stop > size:
            raise ValueError(f"it is cut off: {size} bytes, expected {stop}")
        file.seek(start)
        if element.kind == _COMPRESSED:
            matrix = _Inflated(file.read(min(element.size, _HEAD)), order)
            if matrix.name in names:
                file.seek(start)
                found[matrix.name] = _array(_inflate(file.read(element.size), order), matrix.name, order)
        else:
            name = _name(file.read(min(element.size, _HEAD)), order)
            if name in names:
                file.seek(start)
                found[name] = _array(file.read(element.size), name, order)
        place = stop if element.kind == _COMPRESSED else place + element.stop
    return found


class _Inflated:
    """The beginning of a compressed matrix: its name."""

    def __init__(self, content: bytes, order: str) -> None:
        head = zlib.decompressobj().decompress(content, _HEAD)
        if _element(head, 0, order).kind != _MATRIX:
            raise ValueError("a compressed piece that is no array")
        self.name = _name(head[8:], order)


def _inflate(content: bytes, order: str) -> bytes:
    """A compressed matrix, without its tag; of the size that the tag says, and with the right checksum."""
    stream = zlib.decompressobj()
    size = _element(stream.decompress(content, 8), 0, order).size
    if size > 8 * _MAX_VALUES:
        raise ValueError(f"an array of {size} bytes")
    data = stream.decompress(stream.unconsumed_tail, size + 1)
    if len(data) != size or not stream.eof:
        raise ValueError(f"an array of {len(data)} bytes or more, but of {size} by its header")
    return data


def _element(content: bytes, place: int, order: str) -> _Element:
    """The piece of `content` that begins at `place`; its content may reach beyond."""
    kind, size = struct.unpack_from(f"{order}II", content, place)
    if kind >> 16:  # a small one, with its content in the tag
        return _Element(kind & 0xFFFF, place + 4, min(kind >> 16, 4), place + 8)
    return _Element(kind, place + 8, size, place + 8 + -(-size // 8) * 8)


def _parts(content: bytes, order: str, number: int) -> list[_Element]:
    """The first pieces that a matrix is made of: flags, dimensions, name, numbers."""
    parts: list[_Element] = []
    while len(parts) < number:
        parts.append(_element(content, parts[-1].stop if parts else 0, order))
    return parts


def _name(content: bytes, order: str) -> str:
    *_, name = _parts(content, order, 3)
    return content[name.start : name.start + name.size].decode("latin1")


def _array(content: bytes, name: str, order: str) -> np.ndarray:
    flags, dimensions, _ = _parts(content, order, 3)
    [word] = struct.unpack_from(f"{order}I", content, flags.start)
    kind = word & 0xFF
    if kind not in _CLASSES or word & _COMPLEX:
        raise _NoNumbersError(name, _OTHER_CLASSES.get(kind, "something else"))
    shape = _values(content, dimensions, order).tolist()
    if len(shape) < 2 or min(shape) < 0 or math.prod(shape) > _MAX_VALUES:
        raise ValueError(f"{brief(name)} has the dimensions {shown(shape)}")
    values = _values(content, _parts(content, order, 4)[-1], order)
    if len(values) != math.prod(shape):
        raise ValueError(f"{brief(name)} has {len(values)} numbers for the dimensions {shown(shape)}")
    with np.errstate(invalid="ignore", over="ignore"):
        # MATLAB stores whole numbers in as few bytes as they take, whatever their class.
        return values.astype(_CLASSES[kind]).reshape(shape, order="F")


def _values(content: bytes, element: _Element, order: str) -> np.ndarray:
    if element.kind not in _STORED or element.start + element.size > len(content):
        raise ValueError(
            f"a piece of kind {element.kind} and {element.size} bytes, where numbers were expected"
        )
    kind = np.dtype(order + _STORED[element.kind])
    if element.size % kind.itemsize:
        raise ValueError(f"{element.size} bytes are no whole number of {kind.name}")
    return np.frombuffer(content, kind, element.size // kind.itemsize, element.start)


def _read_hdf5(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    h5py = import_h5py()

    def array(node: Any, name: str, depth: int = 0) -> np.ndarray:
        """MATLAB's array of a data set; of a cell array with one cell, what is in that."""
        if not isinstance(node, h5py.Dataset):
            raise _NoNumbersError(name, "a structure")
        if node.external or node.is_virtual:
            raise ValueError(f"{brief(name)} lies in another file")
        if math.prod(node.shape or ()) > _MAX_VALUES:
            raise ValueError(f"{brief(name)} has the dimensions {shown(node.shape)}")
        if "MATLAB_empty" in node.attrs or node.shape is None:
            return np.zeros((0, 0))
        if h5py.check_ref_dtype(node.dtype) is not None:
            cells = np.ravel(node[()])
            if len(cells) != 1 or depth > _MAX_CELLS_IN_CELLS:
                raise _NoNumbersError(name, f"a cell array of {len(cells)} cells")
            return array(file[cells[0]], name, depth + 1)
        # Letters are uint16.
        if node.dtype.kind not in "biuf" or node.attrs.get("MATLAB_class") == b"char":
            raise _NoNumbersError(name, "text")
        return np.asarray(node[()]).T

    with h5py.File(path, "r") as file:
        links = {name: file.get(name, getlink=True) for name in names if name in file}
        if foreign := [name for name, link in links.items() if not isinstance(link, h5py.HardLink)]:
            raise ValueError(f"{foreign[0]} is a link, which MATLAB does not write")
        return {name: array(file[name], name) for name in links}
