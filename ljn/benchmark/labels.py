"""Real frames with labels, from a file; and how the labels' names map onto SMPL's joints.

The file is an `.npz` without Python objects: `depth_m` `(N, H, W)` metres, 0 = none; `mask` `(N, H, W)`, not 0 on the
person; `K` `(4,)`: fx, fy, cx, cy, pixels; `joints` `(N, J, 3)`, labels, metres, camera frame; `names` `(J,)`. Any
other array of the labels' shape is what another method says of the frames, under its own name.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ljn.body.skeleton import JOINT_INDEX, JOINT_NAMES, MIRROR
from ljn.geometry.camera import Camera, back_project, project
from ljn.reading import READ_ERRORS, read_arrays, reason

_NEEDED = ("depth_m", "mask", "K", "joints", "names")
_FORM = "docs/benchmark.md says what the file is to hold"


@dataclass(frozen=True)
class LabelledFrames:
    """Frames of one camera, one person each.

    Attributes:
        name: The file's stem.
        hash: First 16 hex digits of the file's SHA-256.
        camera: The camera.
        depth: `(N, H, W)` float32, metres, of the person alone; 0 is background.
        joints: `(N, J, 3)` float64, labels, metres, camera frame.
        names: Of the J labels.
        others: What other methods say, by name, `(N, J, 3)` float64.
    """

    name: str
    hash: str
    camera: Camera
    depth: np.ndarray
    joints: np.ndarray
    names: tuple[str, ...]
    others: Mapping[str, np.ndarray]

    def pixels(self) -> np.ndarray:
        """`(N, J, 2)` float32: where the labels are seen, u and v."""
        intrinsics = self.camera.intrinsics(torch.float64)
        return project(torch.from_numpy(self.joints), intrinsics).float().numpy()

    def on_person(self, limit_m: float) -> np.ndarray:
        """`(N, J)` bool: a point of the person's cloud lies within `limit_m` of the label."""
        is_on = np.empty(self.joints.shape[:2], bool)
        for frame, (depth, joints) in enumerate(zip(self.depth, self.joints)):
            v, u = np.nonzero(depth)
            pixels = torch.from_numpy(np.stack([u, v], -1)).double()
            points = back_project(
                pixels, torch.from_numpy(depth[v, u]).double(), self.camera.intrinsics(torch.float64)
            )
            is_on[frame] = torch.cdist(torch.from_numpy(joints), points).amin(1).numpy() <= limit_m
        return is_on


def read_labelled_frames(path: str | Path | None) -> LabelledFrames:
    """Frames and labels of a file of the module's form.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: No file is named, or it is damaged, or an array is missing or wrong.
    """
    if path is None:
        raise ValueError("bench.path: expected a file of real frames, got null; add bench.path=FRAMES.npz")
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"bench.path: no file '{path}'")
    try:
        arrays = read_arrays(path)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except READ_ERRORS as error:
        raise ValueError(f"bench.path: '{path}' cannot be read ({reason(error)}); {_FORM}") from error
    if missing := [name for name in _NEEDED if name not in arrays]:
        raise ValueError(
            f"bench.path: '{path}' lacks {', '.join(missing)}; it has {', '.join(sorted(arrays)) or 'nothing'}; {_FORM}"
        )
    try:
        return _checked(path.stem, digest, arrays)
    except ValueError as error:
        raise ValueError(f"bench.path: '{path}': {error}; {_FORM}") from error


def _checked(name: str, digest: str, arrays: Mapping[str, np.ndarray]) -> LabelledFrames:
    depth = _numbers("depth_m", arrays, ("N", "H", "W"))
    num, height, width = depth.shape
    if num == 0 or height * width == 0:
        raise ValueError(f"depth_m: expected at least one frame with pixels, got {depth.shape}")
    if (depth < 0).any() or float(np.median(depth[depth > 0])) > 100:
        raise ValueError("depth_m: expected metres of 0 or more, got negative values or millimetres")
    mask = arrays["mask"]
    if mask.shape != depth.shape or mask.dtype.kind not in "biu":
        raise ValueError(
            f"mask: expected truth values of depth_m's shape {depth.shape}, got {mask.dtype} of {mask.shape}"
        )
    names = arrays["names"]
    if names.ndim != 1 or names.dtype.kind != "U" or len(set(names.tolist())) != len(names) or not len(names):
        raise ValueError(
            f"names: expected a different text for each joint, got {names.dtype} of {names.shape}"
        )
    shape = (num, len(names), 3)
    joints = _numbers("joints", arrays, shape)
    if (joints[..., 2] <= 0).any():
        raise ValueError(
            "joints: expected labels before the camera (z forward, metres), some have z of 0 or less"
        )
    person = np.where(mask != 0, depth, 0).astype(np.float32)
    if len(empty := np.flatnonzero(~person.any((1, 2)))):
        raise ValueError(
            f"mask: no pixel of the mask has a depth in frame {empty[0]} (of {len(empty)} such frames)"
        )
    fx, fy, cx, cy = map(float, _numbers("K", arrays, (4,)))
    others = {
        key: _numbers(key, arrays, shape)
        for key, value in arrays.items()
        if key not in _NEEDED and value.shape == shape
    }
    camera = Camera(fx, fy, cx, cy, width, height)
    return LabelledFrames(name, digest, camera, person, joints, tuple(names.tolist()), others)


def _numbers(name: str, arrays: Mapping[str, np.ndarray], shape: Sequence[Any]) -> np.ndarray:
    """An array of finite numbers as float64; letters in `shape` stand for any size."""
    values = arrays[name]
    fits = len(values.shape) == len(shape) and all(
        isinstance(expected, str) or expected == got for expected, got in zip(shape, values.shape)
    )
    if not fits or values.dtype.kind not in "iuf":
        words = ", ".join(map(str, shape))
        raise ValueError(f"{name}: expected numbers of shape ({words}), got {values.dtype} of {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: {np.count_nonzero(~np.isfinite(values))} values are NaN or infinite")
    return values.astype(np.float64)


@dataclass(frozen=True)
class JointMap:
    """Which SMPL joints a label of some name is compared with: their mean.

    Attributes:
        names: The labels' names.
        joints: Of each, SMPL's joints, by index.
    """

    names: tuple[str, ...]
    joints: tuple[tuple[int, ...], ...]

    def __call__(self, joints: np.ndarray) -> np.ndarray:
        """`(..., J, 3)` of SMPL's joints `(..., 24, 3)`."""
        return np.stack([joints[..., list(each), :].mean(-2) for each in self.joints], -2)

    @property
    def mirror(self) -> list[int]:
        """Of each name the one on the body's other side; of one in the middle, or without a counterpart, itself."""
        places = {frozenset(each): place for place, each in enumerate(self.joints)}
        return [
            places.get(frozenset(MIRROR[joint] for joint in each), place)
            for place, each in enumerate(self.joints)
        ]

    def keypoints(self, pixels: np.ndarray) -> np.ndarray:
        """SMPL's keypoints `(N, 24, 3)` float32, of the labels `(N, J, 2)` that are one joint each; else NaN and 0."""
        made = np.full((len(pixels), len(JOINT_NAMES), 3), np.nan, np.float32)
        made[..., 2] = 0
        for place, each in enumerate(self.joints):
            if len(each) == 1:
                made[:, each[0], :2], made[:, each[0], 2] = pixels[:, place], 1
        return made


def joint_map(names: Sequence[str], joints: Mapping[str, Any]) -> JointMap:
    """The map of labels of these names; those that `joints` does not have are SMPL's own.

    Args:
        names: The labels' names.
        joints: For a name, an SMPL joint's name or several.

    Raises:
        ValueError: A name, or an SMPL joint's, is unknown.
    """
    chosen = []
    for name in names:
        if name not in joints and name not in JOINT_INDEX:
            raise ValueError(
                f"bench.joints: the file's label '{name}' is not known; known are {', '.join(joints) or 'none'}, and "
                f"SMPL's own names, {', '.join(JOINT_NAMES)}; add bench.joints.{name}=SMPL_JOINT"
            )
        given = joints.get(name, name)
        wanted = [given] if isinstance(given, str) else given
        if not isinstance(wanted, Sequence) or not wanted or not all(each in JOINT_INDEX for each in wanted):
            raise ValueError(
                f"bench.joints.{name}: expected one of SMPL's joints, or a list of some, {', '.join(JOINT_NAMES)}; got "
                f"{given!r}"
            )
        chosen.append(tuple(JOINT_INDEX[each] for each in wanted))
    return JointMap(tuple(names), tuple(chosen))
