"""Pinhole cameras: projection and back-projection (the Pi of Eq. 3.4 and its inverse)."""

import math
from dataclasses import dataclass
from numbers import Real

import torch
from torch import Tensor

from ljn.geometry.rotations import CAMERA_FROM_BODY
from ljn.reading import brief

MAX_PIXELS = 4096 * 4096
"""Of an image."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; pixel centres are at integer coordinates.

    Attributes:
        fx: Focal length in x, pixels.
        fy: Focal length in y, pixels.
        cx: Principal point in x, pixels.
        cy: Principal point in y, pixels.
        width: Image width, pixels.
        height: Image height, pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        values = vars(self).values()
        if not all(isinstance(value, Real) and not isinstance(value, bool) for value in values):
            raise ValueError(f"camera: expected six numbers, pixels, got {brief(str(self))}")
        if not all(0 < value < math.inf for value in (self.fx, self.fy, self.width, self.height)):
            raise ValueError(
                f"camera: focal lengths and image size must be positive and finite, got {brief(str(self))}"
            )
        if self.width % 1 or self.height % 1 or self.width * self.height > MAX_PIXELS:
            raise ValueError(
                f"camera: expected whole numbers of pixels, {MAX_PIXELS} in all at the most, got an image of "
                f"{self.width} x {self.height} (width x height); give the image's own size"
            )
        if not (0 <= self.cx < self.width and 0 <= self.cy < self.height):
            raise ValueError(
                f"camera: the principal point ({self.cx}, {self.cy}) lies outside the image of "
                f"{self.width} x {self.height} (width x height) pixels; are width and height, or cx and cy, swapped?"
            )

    def intrinsics(self, dtype: torch.dtype = torch.float32) -> Tensor:
        """`(4,)`: fx, fy, cx, cy in pixels, the form in which a batch carries its cameras."""
        return torch.tensor([self.fx, self.fy, self.cx, self.cy], dtype=dtype)


def project(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Pixel coordinates of points in front of the camera.

    Args:
        points: `(..., N, 3)`, metres, camera frame, positive depth.
        intrinsics: `(..., 4)`: fx, fy, cx, cy, pixels.

    Returns:
        `(..., N, 2)`: u to the right, v down, pixels.
    """
    focal, centre = intrinsics[..., None, :2], intrinsics[..., None, 2:]
    return points[..., :2] / points[..., 2:] * focal + centre


def back_project(pixels: Tensor, depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Points in space at given pixels and depths; the inverse of `project`.

    Args:
        pixels: `(..., N, 2)`, pixels.
        depth: `(..., N)`, metres along the optical axis (planar depth, not the ray's length).
        intrinsics: `(..., 4)`: fx, fy, cx, cy, pixels.

    Returns:
        `(..., N, 3)`, metres, camera frame.
    """
    focal, centre = intrinsics[..., None, :2], intrinsics[..., None, 2:]
    depth = depth[..., None]
    return torch.cat([(pixels - centre) / focal * depth, depth], -1)


def transfer(pixels: Tensor, intrinsics: Tensor, other: Tensor) -> Tensor:
    """Pixels of one image in another of the same camera frame, such as those of a crop in the whole.

    Args:
        pixels: `(..., N, 2)`, pixels.
        intrinsics: `(..., 4)`: fx, fy, cx, cy of their image.
        other: `(..., 4)`, those of the other image.

    Returns:
        `(..., N, 2)`, pixels of the other image.
    """
    focal, centre = intrinsics[..., None, :2], intrinsics[..., None, 2:]
    return (pixels - centre) / focal * other[..., None, :2] + other[..., None, 2:]


def place_at_root(points: Tensor, root: Tensor, camera_root: Tensor) -> Tensor:
    """Points of a body before the camera: R M + T' of Eq. 4.1, where T' (Eq. 4.2) takes the root where it is seen.

    Args:
        points: `(..., N, 3)`, vertices or joints, metres, body world.
        root: `(..., 3)`, the body's root joint, metres, body world.
        camera_root: `(..., 3)`, the root joint in the camera frame, metres.

    Returns:
        `(..., N, 3)`, metres, camera frame.
    """
    cam_from_body = CAMERA_FROM_BODY.to(points)
    return (points - root[..., None, :]) @ cam_from_body.T + camera_root[..., None, :]
