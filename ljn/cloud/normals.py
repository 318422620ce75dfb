"""Normals of a sampled cloud, pointing towards the camera.

`window` fits a plane in a window of the depth image around each point (fast, from all of the body's pixels);
`open3d` is the thesis's way: Open3D on the sampled points alone. The choice changes what a network sees, so
it is part of a run's configuration.
"""

import math
from collections.abc import Callable

import numba
import numpy as np

from ljn.cloud.sampling import Cloud
from ljn.geometry.camera import Camera
from ljn.optional import import_open3d

NormalEstimator = Callable[[Cloud, np.ndarray, Camera], np.ndarray]
"""`(cloud, noisy depth (H, W), camera) -> (N, 3)` float32 unit normals, camera frame."""


def get_normal_estimator(name: str) -> NormalEstimator:
    """The estimator of that name: `window` or `open3d`.

    Raises:
        ValueError: No such estimator.
        ImportError: Open3D is asked for and missing.
    """
    if name == "window":
        return window_normals
    if name == "open3d":
        import_open3d()
        return open3d_normals
    raise ValueError(f"normals: expected 'window' or 'open3d', got '{name}'")


def open3d_normals(cloud: Cloud, depth: np.ndarray, camera: Camera, neighbours: int = 30) -> np.ndarray:
    """Open3D's normals from the nearest neighbours among the sampled points (section 3.6.1)."""
    open3d = import_open3d()
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points.astype(np.float64)))
    points.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(neighbours))
    points.orient_normals_towards_camera_location(np.zeros(3))
    return np.asarray(points.normals, dtype=np.float32)


def window_normals(
    cloud: Cloud, depth: np.ndarray, camera: Camera, radius_px: int = 2, max_jump_m: float = 0.05
) -> np.ndarray:
    """Normals of planes fitted to the depth image around each point.

    Args:
        cloud: Points and their pixels.
        depth: `(H, W)` float32, metres, with the noise that the points carry; 0 is background.
        camera: The camera of this image.
        radius_px: Half width of the square window.
        max_jump_m: Neighbours whose depth differs by more belong to another surface.

    Returns:
        `(N, 3)` float32. Where fewer than three pixels, or a line of them, remain: towards the camera.
    """
    return _window_normals(
        depth, cloud.pixels, radius_px, max_jump_m, camera.fx, camera.fy, camera.cx, camera.cy
    )


@numba.njit(cache=True, nogil=True)
def _window_normals(
    depth: np.ndarray,
    pixels: np.ndarray,
    radius: int,
    max_jump: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> np.ndarray:
    height, width = depth.shape
    normals = np.empty((len(pixels), 3), np.float32)
    for i in range(len(pixels)):
        u, v = pixels[i, 0], pixels[i, 1]
        z0 = float(depth[v, u])
        x0 = (u - cx) / fx * z0
        y0 = (v - cy) / fy * z0
        count = su = sv = suu = suv = svv = 0
        sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
        for row in range(max(v - radius, 0), min(v + radius + 1, height)):
            for column in range(max(u - radius, 0), min(u + radius + 1, width)):
                zn = float(depth[row, column])
                if zn <= 0.0 or abs(zn - z0) > max_jump:
                    continue
                # Relative to the central point: no cancellation far from the origin.
                x = (column - cx) / fx * zn - x0
                y = (row - cy) / fy * zn - y0
                z = zn - z0
                du, dv = column - u, row - v
                count += 1
                su += du
                sv += dv
                suu += du * du
                suv += du * dv
                svv += dv * dv
                sx += x
                sy += y
                sz += z
                sxx += x * x
                sxy += x * y
                sxz += x * z
                syy += y * y
                syz += y * z
                szz += z * z
        # Exact, in integers: the rays of a line of pixels lie in one plane, and noise would fit just that plane.
        is_line = (count * suu - su * su) * (count * svv - sv * sv) == (count * suv - su * sv) ** 2
        n = max(count, 1)
        nx, ny, nz = _smallest_eigenvector(
            sxx / n - sx * sx / n / n,
            sxy / n - sx * sy / n / n,
            sxz / n - sx * sz / n / n,
            syy / n - sy * sy / n / n,
            syz / n - sy * sz / n / n,
            szz / n - sz * sz / n / n,
        )
        if is_line or (nx == 0.0 and ny == 0.0 and nz == 0.0):
            length = math.sqrt(x0 * x0 + y0 * y0 + z0 * z0)
            nx, ny, nz = -x0 / length, -y0 / length, -z0 / length
        elif nx * x0 + ny * y0 + nz * z0 > 0.0:
            nx, ny, nz = -nx, -ny, -nz
        normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, nz
    return normals


@numba.njit(cache=True, nogil=True)
def _smallest_eigenvector(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float]:
    """Unit eigenvector of the smallest eigenvalue of a symmetric 3x3 matrix; zeros where it is not unique.

    The eigenvalue by the trigonometric solution of the cubic, the vector as the longest cross product of two
    rows of A - lambda I.
    """
    trace = xx + yy + zz
    if trace <= 0.0:
        return 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = xx / trace, xy / trace, xz / trace, yy / trace, yz / trace, zz / trace
    mean = 1.0 / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if spread < 1e-12:
        return 0.0, 0.0, 0.0
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = math.acos(min(1.0, max(-1.0, determinant / (2.0 * spread**3)))) / 3.0
    smallest = mean + 2.0 * spread * math.cos(angle + 2.0 * math.pi / 3.0)
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    best = 0.0
    nx = ny = nz = 0.0
    for pair in range(3):
        if pair == 0:
            x, y, z = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
        elif pair == 1:
            x, y, z = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
        else:
            x, y, z = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
        length = x * x + y * y + z * z
        if length > best:
            best, nx, ny, nz = length, x, y, z
    # `best` is the squared gap between the two smallest eigenvalues, at a trace of 1. The arc cosine knows these
    # to 1e-8 where they agree (points on a line), so that a smaller gap says nothing.
    if best < 1e-12:
        return 0.0, 0.0, 0.0
    length = math.sqrt(best)
    return nx / length, ny / length, nz / length
