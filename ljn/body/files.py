"""Reading body models in SMPL's format: the embedded files, `.npz`, and the official `.pkl`.

A pickle can run any code while it is read. Here none is: whatever the file names is either a plain
container or a class of this module that only records what it was given; arrays are decoded from those
records afterwards. So the official files need neither chumpy nor scipy, and a forged one does no harm.
"""

import hashlib
import io
import math
import pickle
import pickletools
import re
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ljn.body.skeleton import NUM_JOINTS, PARENTS

GENDERS: dict[str, int] = {"female": 0, "male": 1, "neutral": 2}
"""Gender codes: SURREAL's 0 and 1, and neutral."""

NUM_BETAS = 10
NUM_POSE_FEATURES = 9 * (NUM_JOINTS - 1)

_DATA_DIR = Path(__file__).parent / "data"
_KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
"""The arrays of a file, under SMPL's own names."""
_NOT_SMPL = "Give a SMPL model file (not SMPL+H, SMPL-X or MANO)."


@dataclass(frozen=True, eq=False)
class BodyModel:
    """One body in SMPL's form (Eq. 3.1-3.2): checked and read-only, in the SMPL rest frame, metres.

    Attributes:
        v_template: `(V, 3)` float32, the mean shape T in rest pose.
        shapedirs: `(V, 3, 10)` float32, offset for a unit of each shape component (B_s).
        posedirs: `(V, 3, 207)` float32, offset for each entry of R_1 - I ... R_23 - I, row by row (B_p).
        J_regressor: `(24, V)` float32, joints as weighted means of vertices (J).
        weights: `(V, 24)` float32, share of each joint's transform in a vertex (the blend weights W).
        faces: `(F, 3)` int64, vertex indices.
        gender: A key of `GENDERS`.
        path: The file it came from; None if it was built in memory.
        hash: 16 hex digits that name the arrays' content, whatever file format or precision held them.
    """

    v_template: NDArray[np.float32] = field(repr=False)
    shapedirs: NDArray[np.float32] = field(repr=False)
    posedirs: NDArray[np.float32] = field(repr=False)
    J_regressor: NDArray[np.float32] = field(repr=False)
    weights: NDArray[np.float32] = field(repr=False)
    faces: NDArray[np.int64] = field(repr=False)
    gender: str = "neutral"
    path: Path | None = None
    hash: str = field(init=False)

    def __post_init__(self) -> None:
        _check_gender(self.gender)
        num_vertices, num_faces = len(np.atleast_1d(self.v_template)), len(np.atleast_1d(self.faces))
        shapes = {
            "v_template": (num_vertices, 3),
            "shapedirs": (num_vertices, 3, NUM_BETAS),
            "posedirs": (num_vertices, 3, NUM_POSE_FEATURES),
            "J_regressor": (NUM_JOINTS, num_vertices),
            "weights": (num_vertices, NUM_JOINTS),
            "faces": (num_faces, 3),
        }
        digest = hashlib.sha256()
        for name, shape in shapes.items():
            array = self._canonical(name, shape)
            object.__setattr__(self, name, array)
            digest.update(f"{name}{shape}".encode())
            digest.update(array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
        object.__setattr__(self, "hash", digest.hexdigest()[:16])

        for name, array in (("J_regressor", self.J_regressor), ("weights", self.weights)):
            sums = array.sum(axis=1, dtype=np.float64)
            if not np.allclose(sums, 1.0, rtol=0.0, atol=1e-3):
                raise self._error(
                    f"the rows of {name} should each sum to 1, got sums from {sums.min():.4g} "
                    f"to {sums.max():.4g}. {_NOT_SMPL}"
                )
        lowest, highest = self.faces.min(initial=0), self.faces.max(initial=0)
        if lowest < 0 or highest >= num_vertices:
            raise self._error(
                f"faces should index the {num_vertices} vertices, got indices from {lowest} "
                f"to {highest}. {_NOT_SMPL}"
            )

    def _canonical(self, name: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """The named array in the one precision and layout that is hashed: a checked, read-only copy."""
        value = np.asarray(getattr(self, name))
        if value.shape != shape:
            raise self._error(f"{name} should have shape {shape}, got {value.shape}. {_NOT_SMPL}")
        if value.dtype.kind not in "fiu":
            raise self._error(f"{name} should hold real numbers, got dtype {value.dtype}. {_NOT_SMPL}")
        with np.errstate(over="ignore", invalid="ignore"):
            array = np.array(value, np.int64 if name == "faces" else np.float32, order="C")
            array = array + 0  # -0.0 becomes 0.0: a dense and a sparse regressor have one hash
        if not np.isfinite(array).all():
            raise self._error(
                f"{name} should be finite, got NaN or infinite values: damaged. Fetch it again."
            )
        array.flags.writeable = False
        return array

    def _error(self, problem: str) -> ValueError:
        return ValueError(f"{self.path or 'BodyModel'}: {problem}")


def load_body_model(path: str | Path | None = None, gender: str = "neutral") -> BodyModel:
    """A body model read from a file, or an embedded one.

    Args:
        path: A `.npz` or an official `.pkl` in SMPL's format; None takes the embedded body of that gender.
        gender: A key of `GENDERS`: what to take, or, since the files do not say it, what `path` holds.

    Returns:
        The checked model.

    Raises:
        FileNotFoundError: No such file, or no embedded body of that gender.
        ValueError: The file is damaged, is not a SMPL model, or names code that a SMPL model never needs.
    """
    _check_gender(gender)
    if path is None:
        path = _DATA_DIR / f"{gender}.npz"
        if not path.is_file():
            embedded = ", ".join(sorted(file.stem for file in _DATA_DIR.glob("*.npz")))
            raise FileNotFoundError(
                f"gender: no {gender} body is embedded, only: {embedded}. Choose one of these, or give the "
                "path of a SMPL file."
            )
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"path: there is no body model file {path}. Leave the path out for the embedded body; the "
            "official files are at https://smpl.is.tue.mpg.de, after registration."
        )
    readers: dict[str, Callable[[bytes], Mapping[str, Any]]] = {".npz": _read_npz, ".pkl": _read_pickle}
    if path.suffix.lower() not in readers:
        raise ValueError(f"path: a body model should be a .npz or .pkl file, got {path}")

    try:
        arrays = readers[path.suffix.lower()](path.read_bytes())
    except _ForbiddenError as error:
        raise ValueError(f"{path}: {error}") from error
    except _READ_ERRORS as error:
        raise ValueError(
            f"{path}: cannot be read ({error}): damaged, or no SMPL model. Fetch it again."
        ) from error
    return _assemble(arrays, gender, path)


def _assemble(arrays: Mapping[str, Any], gender: str, path: Path) -> BodyModel:
    missing = [key for key in _KEYS if key not in arrays]
    if missing:
        raise ValueError(
            f"{path}: should hold {', '.join(_KEYS)}; missing: {', '.join(missing)}. {_NOT_SMPL}"
        )

    table = arrays["kintree_table"]
    root, *parents = table[0].tolist() if table.shape == (2, NUM_JOINTS) else (None,)
    # The official root is -1 written as an unsigned number.
    if root not in (-1, 2**32 - 1) or tuple(parents) != PARENTS[1:]:
        raise ValueError(
            f"{path}: kintree_table should have shape (2, {NUM_JOINTS}) and begin with {PARENTS}, "
            f"got shape {table.shape} and {(root, *parents)}. {_NOT_SMPL}"
        )
    shapedirs = arrays["shapedirs"]
    if shapedirs.ndim != 3 or shapedirs.shape[2] < NUM_BETAS:
        raise ValueError(
            f"{path}: shapedirs should have shape (V, 3, {NUM_BETAS}) or more components, "
            f"got {shapedirs.shape}. {_NOT_SMPL}"
        )
    return BodyModel(
        v_template=arrays["v_template"],
        shapedirs=shapedirs[:, :, :NUM_BETAS],
        posedirs=arrays["posedirs"],
        J_regressor=arrays["J_regressor"],
        weights=arrays["weights"],
        faces=arrays["f"],
        gender=gender,
        path=path,
    )


def _check_gender(gender: str) -> None:
    if gender not in GENDERS:
        raise ValueError(f"gender: expected one of {', '.join(GENDERS)}, got {gender!r}")


def _read_npz(data: bytes) -> dict[str, NDArray[Any]]:
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise ValueError("not a .npz archive")
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {key: archive[key] for key in _KEYS if key in archive.files}


def _read_pickle(data: bytes) -> dict[str, NDArray[Any]]:
    for opcode, argument, _ in pickletools.genops(data):
        # The C unpickler of Python up to 3.13 allocates as many slots as the largest number says.
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and (argument or 0) > len(data):
            raise ValueError("a memo number beyond the file's size")
    content = _DataUnpickler(io.BytesIO(data), encoding="latin1").load()
    if not isinstance(content, dict):
        raise _ForbiddenError(f"should hold a dict, got {type(content).__name__}. {_NOT_SMPL}")
    return {key: _decode(content[key], key, len(data)) for key in _KEYS if key in content}


class _ForbiddenError(Exception):
    """The file is well formed, but no SMPL model."""


_READ_ERRORS = (
    ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError, TypeError,
    ValueError, pickle.UnpicklingError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What a damaged file makes numpy, zipfile and pickle raise."""


class _Record:
    """Stands for an object of a pickle: keeps what it was made from, and does nothing.

    Having `__setstate__` is what keeps the unpickler from setting attributes on a record or its class.
    """

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


class _Array(_Record):
    """`numpy.ndarray`, and the `_reconstruct` that makes one."""


class _ArrayFromBuffer(_Record):
    """`numpy`'s `_frombuffer`: an array of pickle protocol 5."""


class _Dtype(_Record):
    """`numpy.dtype`."""


class _Bytes(_Record):
    """Python 3's bytes in a pickle of protocol 2: `_codecs.encode(text, "latin1")`, `bytes()`."""


class _Ch(_Record):
    """`chumpy.Ch`: an array under "x"."""


class _Select(_Record):
    """`chumpy.reordering.Select`: entries "idxs" of the flattened array "a"."""


class _Compressed(_Record):
    """`scipy.sparse`'s csr form."""


class _CompressedColumns(_Compressed):
    """`scipy.sparse`'s csc form."""


class _Coordinates(_Record):
    """`scipy.sparse`'s coo form."""


class _Reconstructor(_Record):
    """`copyreg._reconstructor`: Python 2's way to make an instance of a class without calling it."""

    def __new__(cls, kind: Any = None, *_: Any) -> Any:
        if not (isinstance(kind, type) and issubclass(kind, _Record)):
            raise TypeError("_reconstructor of something else than a recorded class")
        return kind()


_NAMES: dict[str, dict[str, type]] = {
    "builtins": {
        "object": _Record, "list": list, "dict": dict, "tuple": tuple, "set": set, "frozenset": frozenset,
        "bytes": _Bytes, "bytearray": _Bytes,
    },
    "collections": {"OrderedDict": dict},
    "copyreg": {"_reconstructor": _Reconstructor},
    "_codecs": {"encode": _Bytes},
    "numpy": {"ndarray": _Array, "dtype": _Dtype},
    "numpy.core.multiarray": {"_reconstruct": _Array, "scalar": _Record},
    "numpy.core.numeric": {"_frombuffer": _ArrayFromBuffer},
    "chumpy.ch": {"Ch": _Ch},
    "chumpy.reordering": {"Select": _Select},
}  # fmt: skip
"""All that a file may name, by module and name, with what stands for it."""

_MODULE_ALIASES = {
    "__builtin__": "builtins",
    "copy_reg": "copyreg",
    "numpy._core.multiarray": "numpy.core.multiarray",
    "numpy._core.numeric": "numpy.core.numeric",
}
_SPARSE = {"csr": _Compressed, "csc": _CompressedColumns, "coo": _Coordinates}


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
            return _SPARSE.get(name[:3], _Record)
        raise _ForbiddenError(
            f"names {module}.{name}, which a SMPL model never needs: nothing of the file was run. "
            "It may not be a SMPL model; get it from a source you trust."
        )


def _decode(value: Any, key: str, limit: int) -> NDArray[Any]:
    """The array that a record describes; no larger than the file, which has `limit` bytes."""
    if isinstance(value, _Array) and isinstance(value.state, tuple) and len(value.state) == 5:
        _, shape, dtype, is_fortran, content = value.state
        return _decode_buffer(content, dtype, shape, "F" if is_fortran else "C")
    if isinstance(value, _ArrayFromBuffer):
        content, dtype, shape, order = value.args[:4]
        return _decode_buffer(content, dtype, shape, order)
    if isinstance(value, _Ch):
        return _decode(value["x"], key, limit)
    if isinstance(value, _Select):
        selected = _decode(value["a"], key, limit).ravel()[_decode(value["idxs"], key, limit).ravel()]
        return selected.reshape(value["preferred_shape"])
    if isinstance(value, _Compressed | _Coordinates):
        return _decode_sparse(value, key, limit)
    raise _ForbiddenError(f"{key} should be an array, a chumpy array or a sparse matrix. {_NOT_SMPL}")


def _decode_buffer(content: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    if not isinstance(dtype, _Dtype):
        raise ValueError("an array without its dtype")
    code = dtype.state[1] + dtype.args[0]
    if not re.fullmatch(r"[<>=|][fiub][1248]", code):
        raise ValueError("an array that holds no plain numbers")
    # Any other shape is no array's: Python would multiply out strings and lists, too.
    if not (isinstance(shape, tuple) and all(isinstance(size, int) for size in shape)):
        raise ValueError("an array without its shape")
    if isinstance(content, _Bytes):
        content = content.args[0] if content.args else b""
    if isinstance(content, str):
        content = content.encode("latin1")
    array = np.frombuffer(content, np.dtype(code))
    if math.prod(shape) != array.size:
        raise ValueError("an array of another size than its shape says")
    return array.reshape(shape, order=order)


def _decode_sparse(matrix: _Record, key: str, limit: int) -> NDArray[Any]:
    num_rows, num_columns = matrix["_shape"]
    # Checked before anything is allocated: a few bytes can claim any shape.
    if min(num_rows, num_columns) < 0 or num_rows * num_columns > limit:
        raise ValueError(f"{key} as a sparse matrix of shape {(num_rows, num_columns)}")
    values = _decode(matrix["data"], key, limit)
    if isinstance(matrix, _Coordinates):
        coordinates = matrix.state.get("coords") or (matrix["row"], matrix["col"])
        rows, columns = (_decode(indices, key, limit) for indices in coordinates)
    else:
        columns = _decode(matrix["indices"], key, limit)
        ends = _decode(matrix["indptr"], key, limit)
        if ends[-1] != len(values):
            raise ValueError(f"{key} as a sparse matrix that ends elsewhere than its values")
        rows = np.searchsorted(ends[1:], np.arange(len(values)), side="right")
        if isinstance(matrix, _CompressedColumns):
            rows, columns = columns, rows
    if min(rows.min(initial=0), columns.min(initial=0)) < 0:
        raise ValueError(f"{key} as a sparse matrix with negative indices")
    dense = np.zeros((num_rows, num_columns))
    np.add.at(dense, (rows, columns), values)
    return dense
