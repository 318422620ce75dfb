"""SURREAL's world and camera, and what becomes of them in ours.

A body in a file (`pose`, z up) was turned by `zrot` about the vertical and then by 90 degrees about x into a world
whose y points down. The camera looks along that world's negative x, and its axes are left-handed (det R = -1): every
image shows its scene in a mirror. Turned back about its middle column, an image is what an ordinary camera would
have seen, and the body in front of it has, in our body world, the file's pose turned by `zrot` about the vertical.
"""

import math

import numpy as np
import torch
from torch import Tensor

from datamodules.sources.surreal.files import IMAGE_SIZE
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import rotation_about, rotmat_to_rotvec, rotvec_to_rotmat

_HEIGHT, _WIDTH = IMAGE_SIZE
_FOCAL_PX = 60 / 32 * _WIDTH  # 60 mm on a sensor of 32 mm
_EDGE_TO_CENTRE = 0.5
"""SURREAL's pixel coordinates begin at an image's edge, as Blender's do, ours in the middle of the first pixel."""

CAMERA = Camera(
    _FOCAL_PX, _FOCAL_PX, _WIDTH / 2 - _EDGE_TO_CENTRE, _HEIGHT / 2 - _EDGE_TO_CENTRE, _WIDTH, _HEIGHT
)
"""The camera of images turned back."""
_MIRRORED_FROM_WORLD = np.array([[0.0, 0, -1], [0, 1, 0], [-1, 0, 0]])


def to_mirrored_camera(points: np.ndarray, camera_place: np.ndarray) -> np.ndarray:
    """Points `(..., 3)` of SURREAL's world in its camera's axes, metres: x right, y down in its images, z forward."""
    return (points - camera_place) @ _MIRRORED_FROM_WORLD.T


def to_camera(points: np.ndarray, camera_place: np.ndarray) -> np.ndarray:
    """Points `(..., 3)` of SURREAL's world in the camera frame of images that are turned back, metres."""
    return to_mirrored_camera(points, camera_place) * [-1.0, 1.0, 1.0]


def to_pixels(points: np.ndarray) -> np.ndarray:
    """Where points `(..., 3)` in `to_mirrored_camera` lie in an image as it stands in the file, `(..., 2)` u and v.

    Of a point in the camera's plane, infinity or NaN; of one behind it, as in `joints2D`, where the line through it and
    the camera meets the image plane.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return points[..., :2] / points[..., 2:] * _FOCAL_PX + [_WIDTH / 2, _HEIGHT / 2]


def turned_pose(pose: np.ndarray, zrot: np.ndarray) -> np.ndarray:
    """Poses `(T, 72)`, radians, in body world before a camera whose images are turned back: turned by `zrot` `(T,)`."""
    return _with_root(pose, rotation_about("z", torch.from_numpy(np.asarray(zrot, np.float64))))


def filmed_pose(pose: np.ndarray, zrot: np.ndarray) -> np.ndarray:
    """Poses `(T, 72)`, radians, in SURREAL's world (y down): log(Rx(90 degrees) Rz(zrot) exp(theta_0))."""
    upright = rotation_about("x", torch.tensor(math.pi / 2, dtype=torch.float64))
    return _with_root(pose, upright @ rotation_about("z", torch.from_numpy(np.asarray(zrot, np.float64))))


def _with_root(pose: np.ndarray, turn: Tensor) -> np.ndarray:
    """Poses `(T, 72)` float64, the first rotation turned from the left by `(T, 3, 3)`."""
    pose = np.asarray(pose, np.float64)
    root = turn @ rotvec_to_rotmat(torch.from_numpy(pose[:, :3]))
    return np.concatenate([rotmat_to_rotvec(root).numpy(), pose[:, 3:]], -1)
