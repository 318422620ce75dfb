"""What SURREAL's files hold: a clip's poses, shapes, joints and camera; the depth images and parts of its frames.

MATLAB drops the last dimension of an array where it is 1, so that a clip of one frame looks otherwise than all others.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datamodules.sources.surreal.matlab import read_mat
from ljn.body.files import NUM_BETAS
from ljn.body.skeleton import NUM_JOINTS
from ljn.reading import shown

INFO = "_info.mat"
DEPTH = "_depth.mat"
SEGMENTATION = "_segm.mat"
VIDEO = ".mp4"
IMAGE_SIZE = (240, 320)  # height, width
BACKGROUND_M = 1e9
"""Depth from here on is background, where the renderer has written 1e10."""
_LARGEST = 100.0  # radians and standard deviations; what is beyond is damage
_FORMS = {
    "pose": (3 * NUM_JOINTS,),
    "shape": (NUM_BETAS,),
    "joints2D": (NUM_JOINTS, 2),
    "joints3D": (NUM_JOINTS, 3),
}


@dataclass(frozen=True)
class Clip:
    """The frames of one `_info.mat`.

    Attributes:
        pose: `(T, 72)` float32 axis-angle, radians, as it stands in the file: z up, heading included.
        betas: `(T, 10)` float32.
        gender: `(T,)` int64, 0 female, 1 male.
        is_good: `(T,)` bool: pose and shape are finite and no larger than bodies' are.
    """

    pose: np.ndarray
    betas: np.ndarray
    gender: np.ndarray
    is_good: np.ndarray

    def __len__(self) -> int:
        return len(self.pose)


@dataclass(frozen=True)
class FilmedClip(Clip):
    """A clip with what SURREAL's own camera says of it.

    Attributes:
        zrot: `(T,)` float64, radians: by which the body was turned about the vertical before it was filmed.
        pixels: `(T, 24, 2)` float64, `joints2D`: u, v of the mirrored image, whole numbers.
        joints: `(T, 24, 3)` float64, `joints3D`: metres, SURREAL's world (y down).
        camera_place: `(3,)` float64, `camLoc`: metres, the same world.
    """

    zrot: np.ndarray
    pixels: np.ndarray
    joints: np.ndarray
    camera_place: np.ndarray


def read_clip(path: Path) -> Clip:
    """The poses and shapes of a `_info.mat`.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is damaged, or a field is missing or of another form; the file and the field are named.
    """
    return Clip(**_bodies(path, _fields(path, ("pose", "shape", "gender"))))


def read_filmed_clip(path: Path) -> FilmedClip:
    """All of a `_info.mat` that the library knows; see `read_clip`.

    A frame whose joints or turn are not finite is not good.
    """
    names = ("pose", "shape", "gender", "zrot", "joints2D", "joints3D", "camLoc")
    arrays = _fields(path, names)
    bodies = _bodies(path, arrays)
    number = len(bodies["pose"])
    zrot = _one_a_frame(path, "zrot", arrays["zrot"], number).astype(np.float64)
    with np.errstate(invalid="ignore"):  # numbers that are none, of damaged files
        pixels, joints = (
            _same_number(path, name, _by_frame(path, name, arrays[name]), number).astype(np.float64)
            for name in ("joints2D", "joints3D")
        )
    place = arrays["camLoc"].astype(np.float64).reshape(-1)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise ValueError(f"{path}: camLoc: expected three finite numbers, got {shown(place.tolist())}")
    bodies["is_good"] &= np.isfinite(zrot)
    for values in (pixels, joints):
        bodies["is_good"] &= np.isfinite(values).all((1, 2))
    return FilmedClip(**bodies, zrot=zrot, pixels=pixels, joints=joints, camera_place=place)


def read_images(path: Path, key: str, frames: Sequence[int]) -> list[np.ndarray]:
    """The images `(240, 320)` of some frames, numbered from 0, in a `_depth.mat` or `_segm.mat`.

    Args:
        path: The file.
        key: What its variables' names begin with: `depth` or `segm`; they end with the frame's number, from 1.
        frames: The frames.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is damaged, or lacks a frame, or one has another form.
    """
    names = [f"{key}_{frame + 1}" for frame in frames]
    arrays = _fields(path, names)
    for name in names:
        if arrays[name].shape != IMAGE_SIZE:
            raise ValueError(f"{path}: {name}: expected an image of {IMAGE_SIZE}, got {arrays[name].shape}")
    return [arrays[name] for name in names]


def _fields(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    arrays = read_mat(path, names)
    if missing := [name for name in names if name not in arrays]:
        raise ValueError(
            f"{path}: no field {', '.join(missing[:5])}; expected a file of SURREAL's, with {shown(names)}"
        )
    return arrays


def _bodies(path: Path, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    pose, betas = (_by_frame(path, name, arrays[name]) for name in ("pose", "shape"))
    number = len(pose)
    betas = _same_number(path, "shape", betas, number)
    gender = _one_a_frame(path, "gender", arrays["gender"], number)
    if not np.isin(gender, (0, 1)).all():
        raise ValueError(
            f"{path}: gender: expected 0 (female) or 1 (male), got {shown(np.unique(gender).tolist())}"
        )
    # A comparison with NaN is false.
    is_good = (np.abs(pose) <= _LARGEST).all(-1) & (np.abs(betas) <= _LARGEST).all(-1)
    with np.errstate(over="ignore", invalid="ignore"):
        pose, betas = pose.astype(np.float32), betas.astype(np.float32)
    return {"pose": pose, "betas": betas, "gender": gender.astype(np.int64), "is_good": is_good}


def _by_frame(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    """`(T, ...)` of MATLAB's `(..., T)`, whose last dimension may be missing, and whose vectors may be rows."""
    form = _FORMS[name]
    turned = values.T
    if turned.shape == form or (turned.ndim == 2 and turned.shape == (*form, 1)):
        turned = turned.reshape(1, *form)
    if turned.ndim != len(form) + 1 or turned.shape[1:] != form or not len(turned):
        expected = ", ".join(map(str, form[::-1]))
        raise ValueError(f"{path}: {name}: expected shape ({expected}, T), got {values.shape}")
    return turned


def _same_number(path: Path, name: str, values: np.ndarray, number: int) -> np.ndarray:
    """Values of as many frames as the pose has; those of one are those of all."""
    if len(values) not in (1, number):
        raise ValueError(f"{path}: {name}: expected the {number} frames of pose, got {len(values)}")
    return np.broadcast_to(values, (number, *values.shape[1:]))


def _one_a_frame(path: Path, name: str, values: np.ndarray, number: int) -> np.ndarray:
    if values.size != max(values.shape, default=1):
        raise ValueError(f"{path}: {name}: expected a number for each frame, got shape {values.shape}")
    return _same_number(path, name, values.reshape(-1), number)
