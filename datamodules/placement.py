"""Where a body stands and which way it faces: the random extrinsics of Eq. 3.4."""

import math

import numba
import numpy as np

from ljn.geometry.camera import Camera

# Share of headings within 45 degrees of facing the camera, beyond 135 degrees, and between (CMU's clips).
_FRONT, _BACK = 0.62, 0.21
HEADINGS = ("source", "histogram", "uniform")


def draw_heading(kind: str, rng: np.random.Generator) -> float:
    """Angle about the vertical, radians in [-pi, pi]; 0 faces the camera. Every kind takes as many draws.

    Kinds are `histogram` (62 % within +-45 degrees, 21 % beyond +-135, 17 % between, flat in each), `uniform`, and
    `source` (no turn: the heading of the pose stays).
    """
    choice, position, sign = rng.random(3)
    if kind == "source":
        return 0.0
    if kind == "uniform":
        low, high = 0.0, math.pi
    elif choice < _FRONT:
        low, high = 0.0, math.pi / 4
    elif choice < _FRONT + _BACK:
        low, high = 3 * math.pi / 4, math.pi
    else:
        low, high = math.pi / 4, 3 * math.pi / 4
    return float(math.copysign(low + position * (high - low), sign - 0.5))


def check_margin(camera: Camera, margin_px: float) -> None:
    """Raise a `ValueError` if a clear border of `margin_px` leaves nothing of the camera's image."""
    if min(camera.width, camera.height) - 1 <= 2 * margin_px:
        raise ValueError(
            f"margin_px: a clear border of {margin_px} px leaves nothing of an image of {camera.width} x "
            f"{camera.height} (width x height) pixels"
        )


def place(
    vertices: np.ndarray,
    camera: Camera,
    uniform: np.ndarray,
    distance_m: tuple[float, float] = (1.5, 3.0),
    margin_px: float = 8.0,
) -> np.ndarray:
    """Translation T of Eq. 3.4 that puts a mesh into the picture.

    The depth of the centre of the mesh's box is uniform in `distance_m`, raised until the mesh fits into the
    image with `margin_px` to spare; then x and y are uniform in what is left. Whether the mesh fits is linear
    in its depth, so the limits are exact, vertex by vertex.

    Args:
        vertices: `(V, 3)`, metres, in the camera's axes, anywhere.
        camera: The camera.
        uniform: `(3,)`: draws in [0, 1) for x, y and depth.
        distance_m: Range of the depth of the box's centre, metres.
        margin_px: Clear border around the mesh, pixels.

    Returns:
        `(3,)` translation, metres.

    Raises:
        ValueError: The image is smaller than its two margins.
    """
    check_margin(camera, margin_px)
    # Slopes of the picture's borders, less the margin: x in [left, right] * depth is in the picture.
    axes = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    slopes = [
        ((margin_px - middle) / focal, (size - 1 - margin_px - middle) / focal)
        for focal, middle, size in axes
    ]
    nearest, farthest, *rooms = _extent(vertices, np.array(slopes, vertices.dtype))
    centre = (nearest + farthest) / 2
    depth = distance_m[0] + uniform[2] * (distance_m[1] - distance_m[0]) - centre
    borders = []
    for (low, high), from_low, to_high in zip(slopes, rooms[::2], rooms[1::2]):
        depth = max(depth, (from_low - to_high) / (high - low))
        borders.append((low, high, from_low, to_high))
    shift = [
        (from_low + low * depth) + uniform[axis] * ((to_high + high * depth) - (from_low + low * depth))
        for axis, (low, high, from_low, to_high) in enumerate(borders)
    ]
    return np.array([*shift, depth])


@numba.njit(cache=True, nogil=True)
def _extent(vertices: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Least and greatest z; for x, then y, the greatest of low * z - x and the least of high * z - x; `(6,)`.

    `slopes` are `(2, 2)`: low and high for x, then y. All in the precision of `vertices` `(V, 3)`.
    """
    extent = np.empty(6, vertices.dtype)
    extent[0], extent[1] = vertices[0, 2], vertices[0, 2]
    for axis in range(2):
        extent[2 + 2 * axis] = slopes[axis, 0] * vertices[0, 2] - vertices[0, axis]
        extent[3 + 2 * axis] = slopes[axis, 1] * vertices[0, 2] - vertices[0, axis]
    for i in range(1, len(vertices)):
        z = vertices[i, 2]
        extent[0], extent[1] = min(extent[0], z), max(extent[1], z)
        for axis in range(2):
            extent[2 + 2 * axis] = max(extent[2 + 2 * axis], slopes[axis, 0] * z - vertices[i, axis])
            extent[3 + 2 * axis] = min(extent[3 + 2 * axis], slopes[axis, 1] * z - vertices[i, axis])
    return extent
