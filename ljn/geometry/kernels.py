"""Grouping and patches on the CPU, compiled by numba: what `ljn.geometry.points` and `patches` run there.

Each follows the tensor form's arithmetic and order to the last bit, so that both give the same values.
"""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def farthest_points(points: np.ndarray, centres: np.ndarray, index: np.ndarray) -> None:
    """Write farthest point sampling of `points` `(B, N, 3)`, from `centres` `(B, 3)` on, into `index` `(B, M)`."""
    num_points = points.shape[1]
    distance = np.empty(num_points, points.dtype)
    for b in range(points.shape[0]):
        xs, ys, zs = points[b, :, 0].copy(), points[b, :, 1].copy(), points[b, :, 2].copy()
        x, y, z = centres[b, 0], centres[b, 1], centres[b, 2]
        for m in range(index.shape[1]):
            if m < 2:  # the centre itself is not among the samples: its distances only begin
                distance[:] = np.inf
            for n in range(num_points):
                dx, dy, dz = x - xs[n], y - ys[n], z - zs[n]
                distance[n] = min(distance[n], dx * dx + dy * dy + dz * dz)
            farthest = np.argmax(distance)
            index[b, m] = farthest
            x, y, z = xs[farthest], ys[farthest], zs[farthest]


@numba.njit(cache=True, nogil=True)
def ball_group(points: np.ndarray, centres: np.ndarray, squared_radii: np.ndarray, index: np.ndarray) -> None:
    """Write the first points `(B, N, 3)` within each ball around `(B, M, 3)` into `index` `(B, M, n)`, n at least 1.

    Underfull balls repeat their points in turn; an empty ball begins with -1. There are `(M,)` squared radii.
    """
    group_size = index.shape[2]
    for b in range(points.shape[0]):
        cloud = points[b]
        for m in range(centres.shape[1]):
            x, y, z = centres[b, m, 0], centres[b, m, 1], centres[b, m, 2]
            limit = squared_radii[m]
            count = 0
            for n in range(points.shape[1]):
                dx, dy, dz = x - cloud[n, 0], y - cloud[n, 1], z - cloud[n, 2]
                if dx * dx + dy * dy + dz * dz <= limit:
                    index[b, m, count] = n
                    count += 1
                    if count == group_size:
                        break
            if count == 0:
                index[b, m, 0] = -1
            else:
                for slot in range(count, group_size):
                    index[b, m, slot] = index[b, m, slot - count]


@numba.njit(cache=True, nogil=True)
def patch_squares(
    crop: np.ndarray,
    crop_camera: np.ndarray,
    points: np.ndarray,
    scales: np.ndarray,
    offsets: np.ndarray,
    limits: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write `ljn.geometry.patches.patch_squares` into `out`, which is zero; `scales` `(S, 2)` holds sizes and units.

    `offsets` `(p,)` are the samples' places along a patch of width 1 about its middle; `limits` `(2,)` are the nearest
    depth of a point and the farthest of a sample, in its unit.
    """
    side, patch_px = crop.shape[1], len(offsets)
    square_px = 4
    per_row, area = patch_px // square_px, square_px * square_px
    nearest, clip = limits
    columns = np.empty(patch_px, np.int64)
    for b in range(points.shape[0]):
        fx, fy, cx, cy = crop_camera[b, 0], crop_camera[b, 1], crop_camera[b, 2], crop_camera[b, 3]
        for k in range(points.shape[1]):
            z = max(points[b, k, 2], nearest)
            u, v = points[b, k, 0] / z * fx + cx, points[b, k, 1] / z * fy + cy
            for s in range(len(scales)):
                size, unit = scales[s, 0], scales[s, 1]
                wide, high = size * fx / z, size * fy / z
                for j in range(patch_px):
                    columns[j] = _pixel(u + offsets[j] * wide, side)
                start = s * 2 * area
                for i in range(patch_px):
                    row = _pixel(v + offsets[i] * high, side)
                    if row < 0:
                        continue
                    for j in range(patch_px):
                        column = columns[j]
                        if column < 0 or not crop[b, row, column] > 0:
                            continue
                        square = (i // square_px) * per_row + j // square_px
                        slot = start + (i % square_px) * square_px + j % square_px
                        relative = (crop[b, row, column] - z) / unit
                        out[b, k, square, slot] = min(max(relative, -clip), clip)
                        out[b, k, square, slot + area] = 1


@numba.njit(cache=True, nogil=True)
def _pixel(position: float, side: int) -> int:
    """The nearest pixel, -1 outside the image (or where the position is not a number)."""
    if not -1 < position < side:
        return -1
    pixel = int(np.rint(position))
    return pixel if pixel < side else -1
