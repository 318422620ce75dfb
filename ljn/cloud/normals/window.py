"""Normals from the depth image: a plane in a window around each point's pixel."""

import numba
import numpy as np

from ljn.cloud.normals.eigenvector import null_vector, scaled, smallest_eigenvalue, towards_camera
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


_LANES = 64
"""Points that are worked on at once: the loops over them become vector instructions."""

(
    _SX, _SY, _SZ, _SXX, _SXY, _SXZ, _SYY, _SYZ, _SZZ, _COUNT,  # sums over the neighbours, relative to the point
    _X, _Y, _Z,  # the point
    _NEIGHBOUR_Z, _NEIGHBOUR_X_SLOPE, _NEIGHBOUR_Y_SLOPE,  # one neighbour: depth, x / z and y / z
    _XX, _XY, _XZ, _YY, _YZ, _ZZ, _SPREAD, _COSINE, _EIGENVALUE,  # the matrix of `scaled` and what it gives
    _NX, _NY, _NZ,  # the normal
    _END,
) = range(0, 29 * _LANES, _LANES)  # fmt: skip
"""Where each quantity of a block of points lies in one array: vector instructions need to know that none overlap."""


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
    x_slopes = (np.arange(width) - cx) / fx
    y_slopes = (np.arange(height) - cy) / fy
    normals = np.empty((len(pixels), 3), np.float32)
    block = np.zeros(_END)
    us, vs = np.zeros(_LANES, np.int64), np.zeros(_LANES, np.int64)
    for start in range(0, len(pixels), _LANES):
        num_points = min(_LANES, len(pixels) - start)
        block[_SX : _COUNT + _LANES] = 0.0
        is_inside = True
        for p in range(num_points):
            u, v = pixels[start + p, 0], pixels[start + p, 1]
            us[p], vs[p] = u, v
            z = float(depth[v, u])
            block[_X + p], block[_Y + p], block[_Z + p] = x_slopes[u] * z, y_slopes[v] * z, z
            is_inside &= radius <= u < width - radius and radius <= v < height - radius
        for dv in range(-radius, radius + 1):
            for du in range(-radius, radius + 1):
                for p in range(num_points):
                    u, v = us[p] + du, vs[p] + dv
                    if is_inside or (0 <= u < width and 0 <= v < height):
                        block[_NEIGHBOUR_Z + p] = depth[np.uint64(v), np.uint64(u)]
                        block[_NEIGHBOUR_X_SLOPE + p] = x_slopes[np.uint64(u)]
                        block[_NEIGHBOUR_Y_SLOPE + p] = y_slopes[np.uint64(v)]
                    else:
                        block[_NEIGHBOUR_Z + p] = 0.0
                _add_neighbour(block, max_jump)
        _scale_matrices(block)
        for p in range(num_points):
            block[_EIGENVALUE + p] = smallest_eigenvalue(block[_SPREAD + p], block[_COSINE + p])
        _fit_planes(block)
        for p in range(num_points):
            nx, ny, nz = block[_NX + p], block[_NY + p], block[_NZ + p]
            # A line of pixels has at most as many as a window's side.
            is_line = block[_COUNT + p] <= 2 * radius + 1 and _is_line(depth, us[p], vs[p], radius, max_jump)
            if is_line or (nx == 0.0 and ny == 0.0 and nz == 0.0):
                nx, ny, nz = towards_camera(block[_X + p], block[_Y + p], block[_Z + p])
            normals[start + p, 0], normals[start + p, 1], normals[start + p, 2] = nx, ny, nz
    return normals


@numba.njit(cache=True, nogil=True)
def _add_neighbour(block: np.ndarray, max_jump: float) -> None:
    """Add one neighbour of each point to its sums, where it is of the same surface."""
    for p in range(_LANES):
        zn = block[_NEIGHBOUR_Z + p]
        # Relative to the central point: no cancellation far from the origin.
        x = block[_NEIGHBOUR_X_SLOPE + p] * zn - block[_X + p]
        y = block[_NEIGHBOUR_Y_SLOPE + p] * zn - block[_Y + p]
        z = zn - block[_Z + p]
        is_near = zn > 0.0 and abs(z) <= max_jump
        x = x if is_near else 0.0
        y = y if is_near else 0.0
        z = z if is_near else 0.0
        block[_SX + p] += x
        block[_SY + p] += y
        block[_SZ + p] += z
        block[_SXX + p] += x * x
        block[_SXY + p] += x * y
        block[_SXZ + p] += x * z
        block[_SYY + p] += y * y
        block[_SYZ + p] += y * z
        block[_SZZ + p] += z * z
        block[_COUNT + p] += 1.0 if is_near else 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _scale_matrices(block: np.ndarray) -> None:
    """The neighbours' covariance at each point, as `scaled` gives it."""
    for p in range(_LANES):
        share = 1.0 / block[_COUNT + p]
        x, y, z = block[_SX + p] * share, block[_SY + p] * share, block[_SZ + p] * share
        xx, xy, xz, yy, yz, zz, spread, cosine = scaled(
            block[_SXX + p] * share - x * x,
            block[_SXY + p] * share - x * y,
            block[_SXZ + p] * share - x * z,
            block[_SYY + p] * share - y * y,
            block[_SYZ + p] * share - y * z,
            block[_SZZ + p] * share - z * z,
        )
        block[_XX + p] = xx
        block[_XY + p] = xy
        block[_XZ + p] = xz
        block[_YY + p] = yy
        block[_YZ + p] = yz
        block[_ZZ + p] = zz
        block[_SPREAD + p] = spread
        block[_COSINE + p] = cosine


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit_planes(block: np.ndarray) -> None:
    """Each point's normal, towards the camera; zeros where no plane fits best."""
    for p in range(_LANES):
        x, y, z = null_vector(
            block[_XX + p],
            block[_XY + p],
            block[_XZ + p],
            block[_YY + p],
            block[_YZ + p],
            block[_ZZ + p],
            block[_EIGENVALUE + p],
        )
        sign = -1.0 if x * block[_X + p] + y * block[_Y + p] + z * block[_Z + p] > 0.0 else 1.0
        block[_NX + p] = sign * x
        block[_NY + p] = sign * y
        block[_NZ + p] = sign * z


@numba.njit(cache=True, nogil=True)
def _is_line(depth: np.ndarray, u: int, v: int, radius: int, max_jump: float) -> bool:
    """Whether the neighbours of one surface are a line of pixels, or one pixel.

    Their rays lie in one plane, and noise would fit just that plane. In integers, so exact.
    """
    height, width = depth.shape
    z = float(depth[v, u])
    count = su = sv = suu = suv = svv = 0
    for dv in range(max(-radius, -v), min(radius, height - 1 - v) + 1):
        for du in range(max(-radius, -u), min(radius, width - 1 - u) + 1):
            zn = float(depth[v + dv, u + du])
            if zn > 0.0 and abs(zn - z) <= max_jump:
                count += 1
                su += du
                sv += dv
                suu += du * du
                suv += du * dv
                svv += dv * dv
    return (count * suu - su * su) * (count * svv - sv * sv) == (count * suv - su * sv) ** 2
