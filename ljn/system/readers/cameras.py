"""Cameras as they are built: with a lens that distorts, and a colour camera beside the depth camera."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ljn.geometry.camera import Camera
from ljn.pipeline.inputs import read_camera_file
from ljn.reading import brief, shown

_MOST_COEFFICIENTS = 8
_FISHEYES = ("equidistant", "fisheye", "kannala", "ftheta")
_FARTHEST_APART_M = 2.0  # of two cameras of one sensor; more is probably millimetres


@dataclass(frozen=True)
class LensCamera:
    """A camera whose images may be distorted, and which may stand beside the depth camera.

    Attributes:
        camera: Its pinhole camera: that of its images once the distortion is undone.
        distortion: OpenCV's coefficients k1, k2, p1, p2, k3, k4, k5, k6, or the first 4 or 5 of them; none without a
            distortion. ROS's plumb_bob and rational_polynomial and RealSense's Brown-Conrady models are the same.
        rgb_from_depth: `(4, 4)`, of a colour camera: takes points from the depth camera's frame to this camera's,
            metres; None where both are in the same place.
    """

    camera: Camera
    distortion: tuple[float, ...] = ()
    rgb_from_depth: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        numbers = list(self.distortion)
        if any(numbers[_MOST_COEFFICIENTS:]) or len(numbers) not in (0, 4, 5, 8, 12, 14):
            raise ValueError(
                "distortion: expected 4, 5 or 8 of OpenCV's coefficients, k1, k2, p1, p2, k3, k4, k5, k6, got "
                f"{shown(numbers)}; calibrate with one of these models"
            )
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError(f"distortion: expected finite numbers, got {shown(numbers)}")
        if self.rgb_from_depth is not None:
            _check_motion(np.asarray(self.rgb_from_depth, np.float64))

    @cached_property
    def lens(self) -> np.ndarray:
        """The lens as `kernels.distort` takes it, `(9,)`; empty without a distortion."""
        if not any(self.distortion):
            return np.zeros(0)
        numbers = np.zeros(_MOST_COEFFICIENTS)
        given = self.distortion[:_MOST_COEFFICIENTS]
        numbers[: len(given)] = given
        k1, k2, _, _, k3, k4, k5, k6 = numbers
        # Beyond the lens's edge the polynomial turns back, and would put directions from outside into the image.
        r = np.linspace(0, 8, 4001)
        r2 = r**2
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radius = r * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / np.where(below > 0, below, np.nan)
        turns = np.flatnonzero(~(np.diff(radius) > 0))
        return np.append(numbers, r2[turns[0]] if len(turns) else r2[-1])

    @cached_property
    def motion(self) -> np.ndarray:
        """`rgb_from_depth` as an array `(4, 4)`; the identity where both cameras are in the same place."""
        return np.eye(4) if self.rgb_from_depth is None else np.array(self.rgb_from_depth, np.float64)

    @property
    def intrinsics(self) -> np.ndarray:
        """`(4,)`: fx, fy, cx, cy, pixels."""
        return np.array([self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy], np.float64)


def read_lens_camera(
    path: str | Path, others: Sequence[str] | None = (), is_rgb: bool = False
) -> tuple[LensCamera, dict[str, Any]]:
    """A camera from any file that `read_camera` takes, with its distortion and, of a colour camera, its place.

    A colour camera's place is `extrinsics`: `rotation` (3 x 3, row by row) or `quaternion_xyzw` or `quaternion_wxyz`,
    and `translation` in metres; or `rgb_from_depth` (4 x 4), there or in place of it. All take points from the depth
    camera's frame to the colour camera's.

    Args:
        path: The file.
        others: See `read_camera_file`; what the file has of them comes back.
        is_rgb: Whether it is a colour camera.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or says something else than a camera.
    """
    places = ("extrinsics", "rgb_from_depth") if is_rgb else ()
    found = read_camera_file(path, None if others is None else (*others, *places))
    if any(found.distortion) and any(name in found.model.lower() for name in _FISHEYES):
        raise ValueError(
            f"camera: the distortion model of '{path}' is '{found.model}', a fisheye; expected OpenCV's 4, 5 or 8 "
            "coefficients (plumb_bob, rational_polynomial): undistort the images beforehand"
        )
    values = dict(found.others)
    motion = None
    try:
        if is_rgb:
            motion = _motion({key: values.pop(key) for key in places if key in values})
        return LensCamera(found.camera, tuple(found.distortion), motion), values
    except ValueError as error:
        raise ValueError(f"camera: {error} (in '{path}')") from error


def _motion(values: dict[str, Any]) -> tuple[tuple[float, ...], ...] | None:
    """`rgb_from_depth` of a file's keys; None without any."""
    if not values:
        return None
    given = values.get("extrinsics", values)
    if not isinstance(given, dict):
        given = {"rgb_from_depth": given}
    turns = ("rotation", "quaternion_xyzw", "quaternion_wxyz")
    if unknown := sorted(str(key) for key in given.keys() - {*turns, "translation", "rgb_from_depth"}):
        raise ValueError(
            f"extrinsics: expected rotation, quaternion_xyzw or quaternion_wxyz with translation, or rgb_from_depth, "
            f"got {brief(', '.join(unknown))}"
        )
    if "rgb_from_depth" in given:
        motion = _array(given["rgb_from_depth"], "rgb_from_depth", 16).reshape(4, 4)
    else:
        motion = np.eye(4)
        motion[:3, :3] = _rotation(given)
        motion[:3, 3] = _array(given.get("translation"), "translation", 3)
    return tuple(map(tuple, motion.tolist()))


def _rotation(given: dict[str, Any]) -> np.ndarray:
    if "rotation" in given:
        return _array(given["rotation"], "rotation", 9).reshape(3, 3)
    for key, order in (("quaternion_xyzw", [0, 1, 2, 3]), ("quaternion_wxyz", [1, 2, 3, 0])):
        if key in given:
            x, y, z, w = _array(given[key], key, 4)[order]
            length = math.hypot(x, y, z, w)
            if abs(length - 1) > 1e-2:
                raise ValueError(f"{key}: expected a unit quaternion, got one of length {length:g}")
            x, y, z, w = x / length, y / length, z / length, w / length
            return np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
                ]
            )
    return np.eye(3)


def _array(value: Any, name: str, size: int) -> np.ndarray:
    """The `size` numbers of a list, or of a list of lists."""
    try:
        numbers = np.asarray(value, np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        numbers = np.zeros(0)
    if numbers.size != size:
        raise ValueError(f"extrinsics: {name}: expected {size} numbers, got {shown(value)}")
    return numbers


def _check_motion(motion: np.ndarray) -> None:
    if motion.shape != (4, 4) or not np.isfinite(motion).all() or not np.allclose(motion[3], [0, 0, 0, 1]):
        raise ValueError(
            f"rgb_from_depth: expected 4 x 4 finite numbers with the last row 0, 0, 0, 1, got {shown(motion.tolist())}"
        )
    turn = motion[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-2) or np.linalg.det(turn) < 0:
        raise ValueError(
            f"extrinsics: rotation: expected a rotation, row by row, got {shown(turn.tolist())}: is it complete and "
            "unscaled?"
        )
    if (distance := float(np.linalg.norm(motion[:3, 3]))) > _FARTHEST_APART_M:
        raise ValueError(
            f"extrinsics: translation: expected metres, at most {_FARTHEST_APART_M:g}, got {distance:g}: millimetres? "
            "Divide by 1000"
        )
