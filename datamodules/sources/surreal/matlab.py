"""MATLAB's files as data: arrays of numbers by name, of versions 4 to 7 (through scipy) and 7.3 (HDF5, through h5py).

Nothing in a file is run, no other file is opened through it, and all that is wrong with one is a `ValueError`.
"""

import math
import warnings
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from scipy.io.matlab import MatReadError

from ljn.optional import import_h5py
from ljn.reading import READ_ERRORS, brief, reason, shown

_HDF5 = b"\x89HDF\r\n\x1a\n"
_HDF5_PLACES = (512, 0)  # MATLAB writes a block of text of its own before it, others may not
_MAX_VALUES = 2**26
_MAX_CELLS_IN_CELLS = 3


def read_mat(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Those of the named arrays that a file has, with MATLAB's order of dimensions.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is damaged, no MATLAB file, or a named variable holds no numbers.
        ImportError: It is of version 7.3, and h5py is not installed.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HDF5_PLACES[0] + len(_HDF5))
            if any(head[place : place + len(_HDF5)] == _HDF5 for place in _HDF5_PLACES):
                found = _read_hdf5(path, names)
            else:
                file.seek(0)
                found = _read_older(file, names)
    except FileNotFoundError:
        raise
    except (*READ_ERRORS, MatReadError, NameError, AssertionError) as error:
        raise ValueError(
            f"{path}: cannot be read as a MATLAB file ({reason(error)}); copy it again"
        ) from error
    for name, values in found.items():
        if values.dtype.kind not in "biuf":
            raise ValueError(f"{path}: {name}: expected numbers, got {brief(str(values.dtype))}")
    return found


def _read_older(file: Any, names: Collection[str]) -> dict[str, np.ndarray]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a variable that comes twice, a name that Python has no letters for
        content = scipy.io.loadmat(file, variable_names=list(names))
    return {name: np.asarray(content[name]) for name in names if name in content}


def _read_hdf5(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    h5py = import_h5py()

    def array(node: Any, depth: int = 0) -> np.ndarray:
        """MATLAB's array of a data set; of a cell array with one cell, what is in that."""
        if not isinstance(node, h5py.Dataset):
            raise ValueError(f"a group of variables, {brief(str(node.name))}, where numbers were expected")
        if node.external or node.is_virtual:
            raise ValueError(f"{brief(str(node.name))} lies in another file")
        if math.prod(node.shape or ()) > _MAX_VALUES:
            raise ValueError(f"{brief(str(node.name))} has the shape {shown(node.shape)}")
        if "MATLAB_empty" in node.attrs:
            return np.zeros((0, 0))
        if h5py.check_ref_dtype(node.dtype) is not None:
            cells = np.ravel(node[()])
            if len(cells) != 1 or depth > _MAX_CELLS_IN_CELLS:
                raise ValueError(f"{brief(str(node.name))} is a cell array of {len(cells)} cells")
            return array(file[cells[0]], depth + 1)
        if node.dtype.kind not in "biuf" or node.attrs.get("MATLAB_class") == b"char":  # letters are uint16
            raise ValueError(f"{brief(str(node.name))} holds no numbers")
        return np.asarray(node[()]).T

    with h5py.File(path, "r") as file:
        links = {name: file.get(name, getlink=True) for name in names if name in file}
        if foreign := [name for name, link in links.items() if not isinstance(link, h5py.HardLink)]:
            raise ValueError(f"{foreign[0]} is a link, which MATLAB does not write")
        return {name: array(file[name]) for name in links}
