"""Arrays out of a pickle without running what it names.

A pickle can run any code while it is read. Here nothing is run: a name in the file becomes either a plain container or
a class of this module that only records its arguments; arrays are decoded from those records afterwards. So
files with chumpy arrays and sparse matrices need neither chumpy nor scipy, and a forged one does no harm.
"""

import io
import math
import pickle
import pickletools
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ljn.reading import brief, check_pickle

_MAX_LEVELS = 5
"""Of arrays made from arrays; official files have three."""


class ForbiddenContentError(Exception):
    """The file is well formed, but holds or names what it should not."""


def read_pickled_arrays(data: bytes, keys: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The arrays of a pickled dict, those of `keys` that it holds; scipy's sparse matrices become dense.

    The dict may also be the one object of an array, as `numpy.save` pickles it.

    Raises:
        ForbiddenContentError: It names something else than arrays and containers, or is not a dict of arrays.
        Exception: Whatever numpy and pickle raise at a damaged file.
    """
    content = _object_of(_unpickled(data))
    if not isinstance(content, dict):
        raise ForbiddenContentError(f"should hold a dict, got {type(content).__name__}.")
    return {key: _decode(content[key], key, len(data)) for key in keys if key in content}


def read_pickled_array(data: bytes, key: str, limit: int) -> NDArray[Any]:
    """The array that is the one object of a pickled array: a sparse matrix of `numpy.savez(FILE, **DICT)`.

    It has no more entries than `limit`, the size of the whole file.

    Raises:
        ForbiddenContentError, Exception: See `read_pickled_arrays`.
    """
    return _decode(_object_of(_unpickled(data)), key, limit)


def _unpickled(data: bytes) -> Any:
    for opcode, argument, _ in pickletools.genops(data):
        # The C unpickler of Python up to 3.13 allocates as many slots as the largest number says.
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and (argument or 0) > len(data):
            raise ValueError("a memo number beyond the file's size")
    check_pickle(data)
    return _DataUnpickler(io.BytesIO(data), encoding="latin1").load()


def _object_of(content: Any) -> Any:
    """The one object of an array of objects; anything else as it is."""
    if _kind_of(content) == "array" and isinstance(content.state, tuple) and len(content.state) == 5:
        _, shape, _, _, objects = content.state
        if shape == () and isinstance(objects, list) and len(objects) == 1:
            return objects[0]
    return content


class _Record:
    """Stands for an object of a pickle: keeps what it was made from, and does nothing.

    Having `__setstate__` is what keeps the unpickler from setting attributes on a record or its class.
    """

    kind = "other"
    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any) -> "_Record":
        record = super().__new__(cls)
        record.args = args
        record.state = None
        return record

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __getitem__(self, key: str) -> Any:
        if not isinstance(self.state, dict) or key not in self.state:
            raise ValueError(f"an object without its {key}")
        return self.state[key]


_KINDS = {
    kind: type(f"_{kind}", (_Record,), {"kind": kind})
    for kind in (
        "array",  # `numpy.ndarray`, and the `_reconstruct` that makes one
        "buffer",  # numpy's `_frombuffer`: an array of pickle protocol 5
        "dtype",  # `numpy.dtype`
        "bytes",  # Python 3's bytes in a pickle of protocol 2: `_codecs.encode(text, "latin1")`, `bytes()`
        "ch",  # `chumpy.Ch`: an array under "x"
        "select",  # `chumpy.reordering.Select`: entries "idxs" of the flattened array "a"
        *("csr", "csc", "coo"),  # the forms of scipy's sparse matrices
    )
}


class _OrderedDict(dict):
    """`collections.OrderedDict`; entries that come as arguments, as Python 2 wrote them, are left out."""

    def __init__(self, *_: Any) -> None:
        super().__init__()


class _Reconstructor(_Record):
    """`copyreg._reconstructor`: Python 2's way to make an instance of a class without calling it."""

    def __new__(cls, kind: Any = None, *_: Any) -> Any:
        if not (isinstance(kind, type) and issubclass(kind, _Record)):
            raise TypeError("_reconstructor of something else than a recorded class")
        return kind()


_NAMES: dict[str, dict[str, type]] = {
    "builtins": {
        # Not the containers themselves: a call for each few bytes of the file could copy a large one.
        "object": _Record, "list": _Record, "dict": _Record, "tuple": _Record, "set": _Record, "frozenset": _Record,
        "bytes": _KINDS["bytes"], "bytearray": _KINDS["bytes"],
    },
    "collections": {"OrderedDict": _OrderedDict},
    "copyreg": {"_reconstructor": _Reconstructor},
    "_codecs": {"encode": _KINDS["bytes"]},
    "numpy": {"ndarray": _KINDS["array"], "dtype": _KINDS["dtype"]},
    "numpy.core.multiarray": {"_reconstruct": _KINDS["array"], "scalar": _Record},
    "numpy.core.numeric": {"_frombuffer": _KINDS["buffer"]},
    "chumpy.ch": {"Ch": _KINDS["ch"]},
    "chumpy.reordering": {"Select": _KINDS["select"]},
}  # fmt: skip
"""All that a file may name, by module and name, with what stands for it."""

_MODULE_ALIASES = {
    "__builtin__": "builtins",
    "copy_reg": "copyreg",
    "numpy._core.multiarray": "numpy.core.multiarray",
    "numpy._core.numeric": "numpy.core.numeric",
}


class _DataUnpickler(pickle.Unpickler):
    """Reads a pickle into containers, text, numbers and records; nothing that it names is imported or run."""

    def find_class(self, module: str, name: str) -> type:
        """The stand-in for a global that the file names."""
        known = _NAMES.get(_MODULE_ALIASES.get(module, module), {})
        if name in known:
            return known[name]
        package = tuple(module.split("."))
        if package[0] == "chumpy":
            return _Record
        if package[:2] == ("scipy", "sparse"):
            return _KINDS[name[:3]] if name[:3] in ("csr", "csc", "coo") else _Record
        raise ForbiddenContentError(
            f"names {brief(f'{module}.{name}')}, which a SMPL model never needs: nothing of the file was run. "
            "It may not be a SMPL model; get it from a source you trust."
        )


def _decode(value: Any, key: str, limit: int, level: int = 0) -> NDArray[Any]:
    """The array that a record describes; no larger than the file, which has `limit` bytes."""
    if level == _MAX_LEVELS:  # a selection from itself by itself, and so on, takes 2^levels steps
        raise ValueError(f"{key} made from arrays in more than {_MAX_LEVELS} levels")
    kind = _kind_of(value)
    if kind == "array" and isinstance(value.state, tuple) and len(value.state) == 5:
        _, shape, dtype, is_fortran, content = value.state
        return _decode_buffer(content, dtype, shape, "F" if is_fortran else "C")
    if kind == "buffer":
        content, dtype, shape, order = value.args[:4]
        return _decode_buffer(content, dtype, shape, order)
    if kind == "ch":
        return _decode(value["x"], key, limit, level + 1)
    if kind == "select":
        array, indices = (_decode(value[name], key, limit, level + 1).ravel() for name in ("a", "idxs"))
        return array[indices].reshape(value["preferred_shape"])
    if kind in ("csr", "csc", "coo"):
        return _decode_sparse(value, key, limit, level + 1)
    raise ForbiddenContentError(f"{key} should be an array, a chumpy array or a sparse matrix.")


def _kind_of(value: Any) -> str | None:
    return value.kind if isinstance(value, _Record) else None


def _decode_buffer(content: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    if _kind_of(dtype) != "dtype":
        raise ValueError("an array without its dtype")
    code = dtype.state[1] + dtype.args[0]
    if not re.fullmatch(r"[<>=|][fiub][1248]", code):
        raise ValueError("an array that holds no plain numbers")
    # Any other shape is no array's: Python would multiply out strings and lists, too.
    if not (isinstance(shape, tuple) and all(isinstance(size, int) for size in shape)):
        raise ValueError("an array without its shape")
    if _kind_of(content) == "bytes":
        content = content.args[0] if content.args else b""
    if isinstance(content, str):
        content = content.encode("latin1")
    array = np.frombuffer(content, np.dtype(code))
    if math.prod(shape) != array.size:
        raise ValueError("an array of another size than its shape says")
    return array.reshape(shape, order=order)


def _decode_sparse(matrix: _Record, key: str, limit: int, level: int) -> NDArray[Any]:
    num_rows, num_columns = matrix["_shape"]
    # Checked before anything is allocated: a few bytes can claim any shape.
    if min(num_rows, num_columns) < 0 or num_rows * num_columns > limit:
        raise ValueError(f"{key} as a sparse matrix of shape {(num_rows, num_columns)}")
    values = _decode(matrix["data"], key, limit, level)
    if matrix.kind == "coo":
        coordinates = matrix.state.get("coords") or (matrix["row"], matrix["col"])
        rows, columns = (_decode(indices, key, limit, level) for indices in coordinates)
    else:
        columns = _decode(matrix["indices"], key, limit, level)
        ends = _decode(matrix["indptr"], key, limit, level)
        if ends[-1] != len(values):
            raise ValueError(f"{key} as a sparse matrix that ends elsewhere than its values")
        rows = np.searchsorted(ends[1:], np.arange(len(values)), side="right")
        if matrix.kind == "csc":
            rows, columns = columns, rows
    if min(rows.min(initial=0), columns.min(initial=0)) < 0:
        raise ValueError(f"{key} as a sparse matrix with negative indices")
    dense = np.zeros((num_rows, num_columns))
    np.add.at(dense, (rows, columns), values)
    return dense
