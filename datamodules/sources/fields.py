"""Fields of `.npz` files of poses, whatever their writer made of their types and dimensions."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from ljn.body import GENDERS
from ljn.body.files import NUM_BETAS
from ljn.body.skeleton import NUM_JOINTS
from ljn.reading import READ_ERRORS, array_in, read_arrays, read_entries, reason, shown

RATES = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")
_BODY_WIDTH = 66  # the 22 joints that SMPL, SMPL-H and SMPL-X share
_WIDTHS = (_BODY_WIDTH, 3 * NUM_JOINTS, 156, 165)
_SHORT = {"f": "female", "m": "male", "n": "neutral"}


def read_fields(path: Path, required: Collection[str], optional: Collection[str]) -> dict[str, np.ndarray]:
    """Arrays of an `.npz` file by name; those of `optional` that are missing, or no plain arrays, are left out.

    Raises:
        ValueError: It cannot be read, or one of `required` is missing.
    """
    try:
        entries = read_entries(path, required)
        if "" in entries:  # an .npy file, or none at all
            array_in(entries[""])
    except READ_ERRORS as error:
        raise ValueError(f"it cannot be read ({reason(error)}); expected a whole .npz file") from error
    if missing := [name for name in required if name not in entries]:
        raise ValueError(f"{missing[0]}: no such field in it")
    fields = {}
    for name in required:
        try:
            fields[name] = array_in(entries[name])
        except READ_ERRORS as error:
            raise ValueError(f"{name}: {reason(error)}") from error
    for name in optional:
        try:
            fields |= read_arrays(path, (name,))
        except READ_ERRORS:  # such as a gender or labels as Python objects
            continue
    return fields


def pose_of(values: np.ndarray, name: str = "poses") -> np.ndarray:
    """Poses `(T, 72)` float64 of SMPL from those of SMPL, SMPL-H, SMPL-X, or of their 22 common joints.

    Hands of others than SMPL are left at rest.
    """
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers, got {values.dtype}")
    if values.ndim == 3 and values.shape[2] == 3:
        values = values.reshape(len(values), 3 * values.shape[1])
    if values.ndim != 2 or values.shape[1] not in _WIDTHS:
        widths = ", ".join(map(str, _WIDTHS))
        raise ValueError(
            f"{name}: expected axis-angle values (T, N) with N one of {widths}, got {values.shape}"
        )
    pose = np.zeros((len(values), 3 * NUM_JOINTS))
    width = values.shape[1] if values.shape[1] == 3 * NUM_JOINTS else _BODY_WIDTH
    pose[:, :width] = values[:, :width]
    return pose


def betas_of(values: np.ndarray, number: int) -> np.ndarray:
    """The first ten shape coefficients, `(10,)`, or `(number, 10)` where there are some for each frame."""
    if values.dtype.kind not in "fiu":
        raise ValueError(f"betas: expected numbers, got {values.dtype}")
    if values.ndim == 2 and len(values) == 1:
        values = values[0]
    if values.ndim not in (1, 2) or (values.ndim == 2 and len(values) != number) or values.shape[-1] == 0:
        raise ValueError(f"betas: expected shape (B,), or (T, B) with T = {number}, got {values.shape}")
    betas = np.zeros((*values.shape[:-1], NUM_BETAS))
    width = min(values.shape[-1], NUM_BETAS)
    betas[..., :width] = values[..., :width]
    return betas


def rate_of(fields: Mapping[str, np.ndarray]) -> float | None:
    """Frames a second; None where the file does not say it, or says what no rate is."""
    for name in RATES:
        if name in fields and fields[name].size == 1 and fields[name].dtype.kind in "fiu":
            rate = float(fields[name].reshape(-1)[0])
            if 0 < rate < 1e5:
                return rate
    return None


def text_of(values: np.ndarray) -> list[str]:
    """Texts or numbers, of one or no dimension, as a list of texts; bytes are decoded."""
    flat = values.reshape(-1)
    if flat.dtype.kind == "S":
        return [entry.decode("utf-8", "replace") for entry in flat.tolist()]
    return [str(entry) for entry in flat.tolist()]


def gender_of(text: str) -> str:
    """A key of `GENDERS`, of a text such as `female`, `F` or `b'female'`.

    Raises:
        ValueError: It names none.
    """
    name = text.strip().removeprefix("b'").strip("' \"").lower()
    name = _SHORT.get(name, name)
    if name not in GENDERS:
        raise ValueError(f"gender: expected one of {', '.join(GENDERS)}, got {shown(text)}")
    return name
