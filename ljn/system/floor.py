"""The floor in a depth image: the plane that people stand on."""

import numpy as np

from ljn.geometry.camera import Camera

_TRIED, _POINTS = 120, 1500
_TILT = np.cos(np.deg2rad(35))
"""Between the floor's normal and the image's vertical, at most."""
_LEAST_SHARE, _LEAST_POINTS = 0.15, 60
_WIDTH_M = 0.9
"""More than a person's clothes are wide."""
_BELOW = 0.04
"""Share of the points that may lie under a floor: of noise and reflections."""


def tolerance_m(z: np.ndarray) -> np.ndarray:
    """How far from a plane a pixel of depth `z` may lie, metres: sensors' noise grows with depth."""
    return 0.010 + 0.002 * z * z


def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """X / z of the columns `(1, W)` and y / z of the rows `(H, 1)`, float32."""
    across = (np.arange(camera.width, dtype=np.float32) - np.float32(camera.cx)) / np.float32(camera.fx)
    down = (np.arange(camera.height, dtype=np.float32) - np.float32(camera.cy)) / np.float32(camera.fy)
    return across[None], down[:, None]


def find_floor(depth: np.ndarray, camera: Camera) -> np.ndarray | None:
    """The floor, as what it takes to know the height of a point.

    Args:
        depth: `(H, W)` float32, metres; 0 is nothing.
        camera: The camera of this image, no more than some 35 degrees from level.

    Returns:
        `(4,)`: a normal up from the floor, and an offset: `normal . point + offset` is a point's height, metres. None
        where no floor is seen.
    """
    rows, columns = np.nonzero(depth[camera.height // 2 :: 2, ::2])
    if len(rows) < _LEAST_POINTS:
        return None
    rng = np.random.default_rng(0)  # equal images have equal floors
    chosen = rng.permutation(len(rows))[:_POINTS]
    v, u = camera.height // 2 + 2 * rows[chosen], 2 * columns[chosen]
    z = depth[v, u].astype(np.float64)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)
    corners = points[rng.integers(len(points), size=(_TRIED, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=-1)
    normals = normals[lengths > 1e-4] / lengths[lengths > 1e-4, None]
    normals *= -np.sign(normals[:, 1:2])  # up: against y
    is_level = -normals[:, 1] > _TILT
    normals, origins = normals[is_level], corners[lengths > 1e-4][is_level, 0]
    if not len(normals):
        return None
    offsets = -(normals * origins).sum(-1)
    heights = points @ normals.T + offsets  # (N, P)
    tolerance = 1.5 * tolerance_m(z)[:, None]
    is_on, is_below = np.abs(heights) < tolerance, heights < -3 * tolerance
    support = is_on.sum(0) - np.where(is_below.sum(0) > _BELOW * len(points), len(points), 0)
    best = int(support.argmax())
    if support[best] < max(_LEAST_POINTS, _LEAST_SHARE * len(points)):
        return None
    normal, offset = normals[best], offsets[best]
    for _ in range(3):
        on = np.abs(points @ normal + offset) < tolerance[:, 0]
        middle = points[on].mean(0)
        normal = np.linalg.eigh((points[on] - middle).T @ (points[on] - middle))[1][:, 0]
        normal = normal * -np.sign(normal[1])
        offset = -normal @ middle
    on = np.abs(points @ normal + offset) < tolerance[:, 0]
    if np.ptp(np.percentile(points[on, 0], [5, 95])) < _WIDTH_M:
        return None
    return np.append(normal, offset)


def heights_m(depth: np.ndarray, camera: Camera, floor: np.ndarray) -> np.ndarray:
    """Height above a floor of every pixel, `(H, W)` float32, metres; of one without depth it says nothing."""
    across, down = rays(camera)
    slope = np.float32(floor[0]) * across + (np.float32(floor[1]) * down + np.float32(floor[2]))
    return depth * slope + np.float32(floor[3])
