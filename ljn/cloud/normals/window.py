"""Normals from the depth image: a plane in a window around each point's pixel."""

import numba
import numpy as np

from ljn.cloud.normals.eigenvector import plane_normal, towards_camera
from ljn.cloud.sampling import Cloud
from ljn.geometry.camera import Camera


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
    # Divided once for each column and row: the same bits as for each neighbour, in less time.
    x_slopes = (np.arange(width) - cx) / fx
    y_slopes = (np.arange(height) - cy) / fy
    normals = np.empty((len(pixels), 3), np.float32)
    for i in range(len(pixels)):
        u, v = pixels[i, 0], pixels[i, 1]
        z0 = float(depth[v, u])
        x0 = x_slopes[u] * z0
        y0 = y_slopes[v] * z0
        count = su = sv = suu = suv = svv = 0
        sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
        for row in range(max(v - radius, 0), min(v + radius + 1, height)):
            for column in range(max(u - radius, 0), min(u + radius + 1, width)):
                zn = float(depth[row, column])
                if zn <= 0.0 or abs(zn - z0) > max_jump:
                    continue
                # Relative to the central point: no cancellation far from the origin.
                x = x_slopes[column] * zn - x0
                y = y_slopes[row] * zn - y0
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
        if is_line:
            nx, ny, nz = towards_camera(x0, y0, z0)
        else:
            products = (sxx, sxy, sxz, syy, syz, szz)
            nx, ny, nz = plane_normal(max(count, 1), (sx, sy, sz), products, (x0, y0, z0))
        normals[i, 0], normals[i, 1], normals[i, 2] = nx, ny, nz
    return normals
