"""Grouping on the CPU, compiled by numba: what `ljn.geometry.points` runs where the tensors are on a CPU.

Each follows the tensor form's arithmetic and order to the last bit, so that both give the same indices.
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
