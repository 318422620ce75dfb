"""Reading body models in SMPL's format: the embedded files, `.npz`, the official `.pkl`, and what numpy saves of it.

The official files may hold chumpy arrays and scipy's sparse matrices; `ljn.body.unpickling` reads them without
either package and without running anything.
"""

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ljn.body.skeleton import NUM_JOINTS, PARENTS
from ljn.body.unpickling import ForbiddenContentError, read_pickled_array, read_pickled_arrays
from ljn.reading import READ_ERRORS, array_in, pickle_in, read_entries, reason, shown

GENDERS: dict[str, int] = {"female": 0, "male": 1, "neutral": 2}
"""Gender codes: SURREAL's 0 and 1, and neutral."""

NUM_BETAS = 10
NUM_POSE_FEATURES = 9 * (NUM_JOINTS - 1)

_DATA_DIR = Path(__file__).parent / "data"
_KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
"""The arrays of a file, under SMPL's own names."""
_NOT_SMPL = "Give a SMPL model file (not SMPL+H, SMPL-X or MANO)."
_FAMILY = {52: "SMPL+H", 55: "SMPL-X", 16: "MANO", 5: "FLAME"}
"""Of SMPL's relatives, the numbers of joints."""
_SMPLX_VERTICES = 10475
_SMPL_HOME = "https://smpl.is.tue.mpg.de"
_FOLDERS = (
    "",
    "smpl",
    "models",
    "smpl/models",
    "SMPL_python_v.1.1.0/smpl/models",
    "SMPL_python_v.1.0.0/smpl/models",
)
"""Where in a user's folder the files may lie: as smplx has them, and as the official archives unpack."""


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
        hash: 16 hex digits that name the arrays' content, independent of file format and stored precision.
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
                got = f"got sums from {sums.min():.4g} to {sums.max():.4g}"
                raise self._error(f"the rows of {name} should each sum to 1, {got}. {_NOT_SMPL}")
        lowest, highest = self.faces.min(initial=0), self.faces.max(initial=0)
        if lowest < 0 or highest >= num_vertices:
            got = f"got indices from {lowest} to {highest}"
            raise self._error(f"faces should index the {num_vertices} vertices, {got}. {_NOT_SMPL}")

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
    """A body model read from a file, or an embedded one; checked.

    Args:
        path: A `.npz` or an official `.pkl` in SMPL's format, or what `numpy.save` or `savez` made of its dict; None
            takes the embedded body of that gender.
        gender: A key of `GENDERS`: what to take, or, since the files do not say it, what `path` holds.

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
            f"path (body.path): there is no body model file {path}. Leave the path out for the embedded body. "
            f"{_OFFICIAL}"
        )
    if path.suffix.lower() not in _READERS:
        raise ValueError(f"path: a body model should be a .npz, .npy or .pkl file, got {path}")

    try:
        arrays = _READERS[path.suffix.lower()](path)
    except ForbiddenContentError as error:
        raise ValueError(f"{path}: {error} {_NOT_SMPL}") from error
    except READ_ERRORS as error:
        raise ValueError(
            f"{path}: cannot be read ({reason(error)}): damaged, or no SMPL model. Fetch it again."
        ) from error
    body = _assemble(arrays, gender, path)
    _check_rest_pose(body)
    return body


def _check_rest_pose(body: BodyModel) -> None:
    """Raise a `ValueError` for a body in another unit than metres, or one whose rest pose does not stand along y."""
    across, up, forward = np.ptp(body.v_template, axis=0).tolist()
    shown = f"{across:.2f} x {up:.2f} x {forward:.2f} (x, y, z)"
    if not 0.2 < max(across, up, forward) < 10:
        raise body._error(
            f"v_template should be in metres, but measures {shown}: centimetres or millimetres? Divide v_template, "
            "shapedirs and posedirs by 100 or 1000"
        )
    if forward > 2 * up:
        raise body._error(
            f"v_template should stand along y, facing z, but measures {shown}: z up? Turn v_template, shapedirs and "
            "posedirs by -90 degrees about x"
        )


def load_body_models(path: str | Path | None, genders: Sequence[str]) -> tuple[BodyModel, ...]:
    """The bodies of several genders: the embedded ones, or a user's files.

    Args:
        path: None takes the embedded bodies. A folder gives each gender from `SMPL_FEMALE.pkl`, `female.npz` or
            the official `basicmodel_f_lbs_...pkl` in it (capitals do not matter), or in its `smpl`, `models` or
            `smpl/models`. A file serves one gender.
        genders: Keys of `GENDERS`.

    Returns:
        One model for each gender, in the order asked for.

    Raises:
        FileNotFoundError: No file for a gender.
        ValueError: A file for several genders; several files for a gender; or see `load_body_model`.
    """
    for gender in genders:
        _check_gender(gender)
    if path is None or not Path(path).is_dir():
        if path and Path(path).is_file() and len(genders) > 1:
            raise ValueError(
                f"path: the file {path} holds one body, but bodies of {', '.join(genders)} are asked for; give a "
                "folder with a file for each, or ask for one gender (body.genders=[neutral])"
            )
        return tuple(load_body_model(path, gender) for gender in genders)

    def file_of(gender: str) -> Path:
        named = (_named_for(gender, Path(path) / folder) for folder in _FOLDERS)
        files = next((each for each in named if each), [])
        if not files:
            there = ", ".join(sorted(file.name for file in Path(path).iterdir())[:6]) or "nothing"
            raise FileNotFoundError(
                f"path (body.path): no body of gender {gender} in {path}; expected SMPL_{gender.upper()}.pkl, "
                f"{gender}.npz or the official name (basicmodel_..._lbs_10_207_0_v1.1.0.pkl). Put it there, or leave "
                f"the gender out (body.genders, body.predicted). There is: {there}. Files of SMPL+H and SMPL-X do not "
                f"serve, nor do archives that are not unpacked. {_OFFICIAL}"
            )
        if len(files) > 1:
            names = ", ".join(file.name for file in files)
            raise ValueError(f"path: several bodies of gender {gender} in {path}: {names}; leave one there")
        return files[0]

    return tuple(load_body_model(file_of(gender), gender) for gender in genders)


def _named_for(gender: str, folder: Path) -> list[Path]:
    """The files of a folder, which need not be there, that are named as bodies of a gender."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    bodies = (file for file in files if file.suffix.lower() in _READERS)
    return [file for file in bodies if _FILE_NAMES[gender].fullmatch(file.stem.lower())]


def _check_family(arrays: Mapping[str, Any], path: Path) -> None:
    """Raise a `ValueError` that names the model, if a file holds one of SMPL's relatives."""
    shapes = {name: np.shape(arrays[name]) for name in _KEYS if name in arrays}
    places = {"kintree_table": -1, "J_regressor": 0, "weights": -1}
    numbers = {shapes[name][place] for name, place in places.items() if len(shapes.get(name, ())) == 2}
    num_vertices = next(iter(shapes.get("v_template", ())), 0)
    names = [_FAMILY[number] for number in sorted(numbers) if number in _FAMILY]
    if num_vertices == _SMPLX_VERTICES:
        names = [_FAMILY[55]]
    if names:
        raise ValueError(
            f"{path}: this is a {names[0]} file ({max(numbers, default=0)} joints, {num_vertices} vertices); expected "
            f"SMPL's {NUM_JOINTS} joints (and 6890 vertices). {_OFFICIAL}"
        )


def _assemble(arrays: Mapping[str, Any], gender: str, path: Path) -> BodyModel:
    _check_family(arrays, path)
    if missing := ", ".join(key for key in _KEYS if key not in arrays):
        raise ValueError(f"{path}: should hold {', '.join(_KEYS)}; missing: {missing}. {_NOT_SMPL}")
    table = arrays["kintree_table"]
    root, *parents = table[0].tolist() if table.shape == (2, NUM_JOINTS) else (None,)
    # The official root is -1 written as an unsigned number.
    if root not in (-1, 2**32 - 1, 2**64 - 1) or tuple(parents) != PARENTS[1:]:
        raise ValueError(
            f"{path}: kintree_table should have shape (2, {NUM_JOINTS}) and begin with {PARENTS}, "
            f"got shape {table.shape} and {shown((root, *parents))}. {_NOT_SMPL}"
        )
    shapedirs = arrays["shapedirs"]
    if shapedirs.ndim != 3 or shapedirs.shape[2] < NUM_BETAS:
        raise ValueError(
            f"{path}: shapedirs should have shape (V, 3, {NUM_BETAS}) or more components, "
            f"got {shapedirs.shape}. {_NOT_SMPL}"
        )
    others = {name: arrays[name] for name in ("v_template", "posedirs", "J_regressor", "weights")}
    shapedirs = shapedirs[:, :, :NUM_BETAS]
    return BodyModel(**others, shapedirs=shapedirs, faces=arrays["f"], gender=gender, path=path)


def _check_gender(gender: str) -> None:
    if gender not in GENDERS:
        raise ValueError(f"gender: expected one of {', '.join(GENDERS)}, got {gender!r}")


_OFFICIAL = (
    f"The official SMPL files are at {_SMPL_HOME} (SMPL for Python, version 1.1.0), after registration: put "
    "basicmodel_f_lbs_10_207_0_v1.1.0.pkl, basicmodel_m_... and basicmodel_neutral_... into one folder and name it "
    "with body=smpl body.path=FOLDER."
)
_FILE_NAMES = {
    gender: re.compile(rf"(smpl_)?{gender}|basicmodel_{official}_.*")
    for gender, official in (("female", "f"), ("male", "m"), ("neutral", "neutral"))
}


def _read_saved(path: Path) -> Mapping[str, Any]:
    """The arrays of `numpy.savez(FILE, **DICT)`, `savez(FILE, DICT)` or `save(FILE, DICT)`."""
    entries = read_entries(path, (*_KEYS, "arr_0", ""))
    whole = entries.get("arr_0", entries.get(""))
    if whole is not None and (pickled := pickle_in(whole)) is not None:
        return read_pickled_arrays(pickled, _KEYS)
    limit = sum(map(len, entries.values()))
    contents = {key: (content, pickle_in(content)) for key, content in entries.items() if key in _KEYS}
    return {
        key: array_in(content) if pickled is None else read_pickled_array(pickled, key, limit)
        for key, (content, pickled) in contents.items()
    }


_READERS: dict[str, Callable[[Path], Mapping[str, Any]]] = {
    ".npz": _read_saved,
    ".npy": _read_saved,
    ".pkl": lambda path: read_pickled_arrays(path.read_bytes(), _KEYS),
}
