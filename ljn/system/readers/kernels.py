"""Colours brought to the depth image's pixels, and lenses, compiled by numba."""

import math

import numba
import numpy as np

CELLS_PER_PIXEL = 1.5
"""Cells of the z-buffer, along a line, to a pixel of the depth image: enough to tell neighbouring pixels apart."""
_REACH = (
    0.6 * CELLS_PER_PIXEL
)  # half the side that a pixel covers, cells: neighbours on a slanted surface leave no gap
# What is hidden lies at least so far behind: pixels of one slanted surface do not hide each other, and what lies
# nearer to each other than this is shifted by less than a pixel.
_BEHIND_M, _BEHIND_SHARE = 0.02, 0.02


@numba.njit(cache=True, nogil=True)
def distort(x: float, y: float, lens: np.ndarray) -> tuple[float, float]:
    """Where a lens puts the direction (x / z, y / z); NaN beyond its edge.

    `lens` `(9,)` are OpenCV's k1, k2, p1, p2, k3, k4, k5, k6, and the largest squared distance from the axis at which
    they hold.
    """
    r2 = x * x + y * y
    if not r2 <= lens[8]:
        return math.nan, math.nan
    radial = 1.0 + r2 * (lens[0] + r2 * (lens[1] + r2 * lens[4]))
    radial /= 1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[7]))
    p1, p2 = lens[2], lens[3]
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
    )


@numba.njit(cache=True, nogil=True)
def write_distorted(intrinsics: np.ndarray, lens: np.ndarray, places: np.ndarray) -> None:
    """Write u and v of each pixel of a straight image in the distorted one into `places` `(2, H, W)`; -1e6 for nowhere.

    `intrinsics` `(4,)` are fx, fy, cx, cy of both.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for v in range(places.shape[1]):
        for u in range(places.shape[2]):
            x, y = distort((u - cx) / fx, (v - cy) / fy, lens)
            places[0, v, u] = x * fx + cx if x == x else -1e6
            places[1, v, u] = y * fy + cy if y == y else -1e6


@numba.njit(cache=True, nogil=True)
def find_places(
    depth: np.ndarray,
    intrinsics: np.ndarray,
    rgb_from_depth: np.ndarray,
    rgb_intrinsics: np.ndarray,
    lens: np.ndarray,
    rgb_size: tuple[int, int],
    scale: float,
    places: np.ndarray,
    nearest: np.ndarray,
) -> None:
    """Write where the colour camera sees each depth pixel, and how near the nearest is that it sees there.

    Args:
        depth: `(H, W)`, metres.
        intrinsics: `(4,)` of the depth camera.
        rgb_from_depth: `(4, 4)`, metres.
        rgb_intrinsics: `(4,)` of the colour camera.
        lens: `(9,)` of the colour camera, see `distort`; without a first element other than 0 it may be empty.
        rgb_size: Height and width of its image.
        scale: Cells of `nearest` to a pixel of the colour image.
        places: `(H, W, 3)`, gets u and v in the colour image and the depth there, metres; 0 where it sees nothing.
        nearest: `(cells high, cells wide)`, gets metres.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    rgb_fx, rgb_fy, rgb_cx, rgb_cy = (
        rgb_intrinsics[0],
        rgb_intrinsics[1],
        rgb_intrinsics[2],
        rgb_intrinsics[3],
    )
    m = rgb_from_depth
    height, width = rgb_size
    nearest[:] = np.inf
    for v in range(depth.shape[0]):
        y = (v - cy) / fy
        row_x, row_y, row_z = m[0, 1] * y + m[0, 2], m[1, 1] * y + m[1, 2], m[2, 1] * y + m[2, 2]
        for u in range(depth.shape[1]):
            places[v, u, 2] = 0.0
            z = depth[v, u]
            if not z > 0.0:
                continue
            x = (u - cx) / fx
            rgb_z = z * (m[2, 0] * x + row_z) + m[2, 3]
            if not rgb_z > 1e-3:
                continue
            rgb_x = (z * (m[0, 0] * x + row_x) + m[0, 3]) / rgb_z
            rgb_y = (z * (m[1, 0] * x + row_y) + m[1, 3]) / rgb_z
            if lens.size:
                rgb_x, rgb_y = distort(rgb_x, rgb_y, lens)
            rgb_u, rgb_v = rgb_x * rgb_fx + rgb_cx, rgb_y * rgb_fy + rgb_cy
            if not (-0.5 <= rgb_u < width - 0.5 and -0.5 <= rgb_v < height - 0.5):
                continue
            places[v, u, 0], places[v, u, 1], places[v, u, 2] = rgb_u, rgb_v, rgb_z
            across, down = (rgb_u + 0.5) * scale, (rgb_v + 0.5) * scale
            reach = _REACH * z / rgb_z
            left, right = _covered(across, reach, nearest.shape[1])
            top, bottom = _covered(down, reach, nearest.shape[0])
            for i in range(top, bottom + 1):
                for j in range(left, right + 1):
                    nearest[i, j] = min(nearest[i, j], places[v, u, 2])


@numba.njit(cache=True, nogil=True)
def _covered(middle: float, reach: float, size: int) -> tuple[int, int]:
    """First and last of `size` cells whose middles are covered; that around `middle` at least."""
    own = min(int(middle), size - 1)
    first, last = math.ceil(middle - reach - 0.5), math.floor(middle + reach - 0.5)
    return max(0, min(own, first)), min(size - 1, max(own, last))


@numba.njit(cache=True, nogil=True)
def take_colours(
    rgb: np.ndarray, places: np.ndarray, nearest: np.ndarray, scale: float, colours: np.ndarray
) -> None:
    """Write each depth pixel's colour, bilinear, into `colours` `(H, W, 3)`; black where it is hidden or unknown.

    `rgb` is `(h, w, 3)`; the others are those of `find_places`.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    for v in range(places.shape[0]):
        for u in range(places.shape[1]):
            rgb_u, rgb_v, z = places[v, u, 0], places[v, u, 1], places[v, u, 2]
            is_seen = z > 0.0
            if is_seen:
                i = min(int((rgb_v + 0.5) * scale), nearest.shape[0] - 1)
                j = min(int((rgb_u + 0.5) * scale), nearest.shape[1] - 1)
                is_seen = z <= nearest[i, j] * (1.0 + _BEHIND_SHARE) + _BEHIND_M
            if not is_seen:
                colours[v, u, 0] = colours[v, u, 1] = colours[v, u, 2] = 0
                continue
            rgb_u, rgb_v = min(max(rgb_u, 0.0), width - 1.0), min(max(rgb_v, 0.0), height - 1.0)
            left, top = int(rgb_u), int(rgb_v)
            right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
            across, down = rgb_u - left, rgb_v - top
            for k in range(3):
                above = rgb[top, left, k] * (1.0 - across) + rgb[top, right, k] * across
                below = rgb[bottom, left, k] * (1.0 - across) + rgb[bottom, right, k] * across
                colours[v, u, k] = int(above * (1.0 - down) + below * down + 0.5)
