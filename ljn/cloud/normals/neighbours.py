"""Normals from the nearest neighbours among the sampled points (section 3.6.1): by Open3D, and without it."""

import math

import numba
import numpy as np

from ljn.cloud.normals.eigenvector import plane_normal
from ljn.cloud.sampling import Cloud
from ljn.geometry.camera import Camera
from ljn.optional import import_open3d


def open3d_normals(cloud: Cloud, depth: np.ndarray, camera: Camera, neighbours: int = 30) -> np.ndarray:
    """Open3D's normals from the nearest neighbours among the sampled points (section 3.6.1)."""
    open3d = import_open3d()
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points.astype(np.float64)))
    points.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(neighbours))
    points.orient_normals_towards_camera_location(np.zeros(3))
    return np.asarray(points.normals, dtype=np.float32)


def knn_normals(cloud: Cloud, depth: np.ndarray, camera: Camera, neighbours: int = 30) -> np.ndarray:
    """Normals of planes fitted to the nearest neighbours among the sampled points; Open3D's, without Open3D.

    `(N, 3)` float32; where the neighbours are one place or a line: towards the camera. A point counts among its
    neighbours, and one that comes twice counts twice; where there are fewer points, all count. As of every estimator,
    depth and camera are arguments, too.

    Raises:
        ValueError: A point is not finite, or fewer than three neighbours are asked for.
    """
    if neighbours < 3:
        raise ValueError(f"neighbours: expected at least 3, got {neighbours}")
    if not np.isfinite(cloud.points).all():
        raise ValueError("points: NaN or infinite values; check the depth image")
    if len(cloud.points) == 0:
        return np.empty((0, 3), np.float32)
    points = np.ascontiguousarray(cloud.points.T, dtype=np.float64)
    return _knn_normals(points, min(neighbours, len(cloud.points)))


# Points are sorted into the cells of a grid. The candidates for a point's neighbours are the points in the block of
# cells around its own; the nearest of them are its neighbours for certain if they are nearer than the block's
# border, else the block grows. All points of a cell share a block, which is small and contiguous: a few plain passes
# over it are faster than a tree.


@numba.njit(cache=True, nogil=True)
def _knn_normals(points: np.ndarray, k: int) -> np.ndarray:
    """Normals `(N, 3)` float32 of points `(3, N)` from their `k <= N` nearest."""
    num_points = points.shape[1]
    corner, size, shape = _choose_grid(points, 0.3 * k)
    order, start = _sort_into_cells(points, corner, size, shape)
    points = np.ascontiguousarray(points[:, order])
    shared, private = np.empty((3, num_points)), np.empty((3, num_points))
    squared, work = np.empty(num_points), np.empty(num_points + 1)
    chosen = np.empty(num_points + 1, np.int64)
    normals = np.empty((num_points, 3), np.float32)
    smallest_guess = 1e-6 * size * size
    limit, num_within = size * size, 0
    for cell in range(len(start) - 1):
        if start[cell] == start[cell + 1]:
            continue
        num_shared = _copy_block(points, start, shape, cell, 1, shared)
        for i in range(start[cell], start[cell + 1]):
            place = points[0, i], points[1, i], points[2, i]
            reach, block, num_block = 1, shared, num_shared
            while True:
                border = _distance_to_border(place, corner, size, shape, cell, reach)
                if num_block >= k:
                    for j in range(num_block):
                        dx, dy, dz = block[0, j] - place[0], block[1, j] - place[1], block[2, j] - place[2]
                        squared[j] = dx * dx + dy * dy + dz * dz
                    # The last point's limit is a good guess: it was in the same cell or close to it.
                    guess = max(limit, smallest_guess)
                    limit, num_within = _limit_of_nearest(squared[:num_block], k, guess, work)
                    if limit <= border * border:
                        break
                reach *= 2
                block, num_block = private, _copy_block(points, start, shape, cell, reach, private)
            _choose_nearest(squared[:num_block], k, limit, num_within, chosen)
            normal = _fit_plane(block, chosen[:k], place)
            normals[order[i], 0], normals[order[i], 1], normals[order[i], 2] = normal
    return normals


@numba.njit(cache=True, nogil=True)
def _choose_grid(
    points: np.ndarray, points_per_cell: float
) -> tuple[np.ndarray, float, tuple[int, int, int]]:
    """The grid's lower corner, the size of a cell, the number of cells along x, y and z.

    A cell that is not empty holds about `points_per_cell` on average, unless that takes too many cells.
    """
    num_points = points.shape[1]
    max_cells = 16 * num_points + 64
    corner, extent = np.empty(3), np.empty(3)
    for axis in range(3):
        low = high = points[axis, 0]
        for i in range(num_points):
            low, high = min(low, points[axis, i]), max(high, points[axis, i])
        corner[axis], extent[axis] = low, high - low
    # Points lie on a surface: their number in a cell grows with the square of its size.
    diagonal = math.sqrt(extent[0] ** 2 + extent[1] ** 2 + extent[2] ** 2)
    size = math.sqrt(0.2 * points_per_cell / num_points) * diagonal
    size, shape = _enlarge(size, extent, max_cells)
    for _ in range(2):
        is_used = np.zeros(shape[0] * shape[1] * shape[2], np.bool_)
        num_used = 0
        for i in range(num_points):
            cell = _cell_of(points, i, corner, size, shape)
            num_used += not is_used[cell]
            is_used[cell] = True
        size *= math.sqrt(points_per_cell * num_used / num_points)
        size, shape = _enlarge(size, extent, max_cells)
    return corner, size, shape


@numba.njit(cache=True, nogil=True)
def _enlarge(size: float, extent: np.ndarray, max_cells: int) -> tuple[float, tuple[int, int, int]]:
    """The size, or the next at which the grid has at most `max_cells`, and its number of cells along x, y and z."""
    if size <= 0.0:
        size = 1.0
    while True:
        # In floating point, where the product cannot overflow.
        nx, ny = math.floor(extent[0] / size) + 1.0, math.floor(extent[1] / size) + 1.0
        nz = math.floor(extent[2] / size) + 1.0
        if nx * ny * nz <= max_cells:
            return size, (int(nx), int(ny), int(nz))
        size *= 1.1


@numba.njit(cache=True, nogil=True)
def _cell_of(points: np.ndarray, i: int, corner: np.ndarray, size: float, shape: tuple[int, int, int]) -> int:
    """Number of point `i`'s cell; along x they follow each other."""
    nx, ny, _ = shape
    x, y = int((points[0, i] - corner[0]) / size), int((points[1, i] - corner[1]) / size)
    z = int((points[2, i] - corner[2]) / size)
    return (z * ny + y) * nx + x


@numba.njit(cache=True, nogil=True)
def _sort_into_cells(
    points: np.ndarray, corner: np.ndarray, size: float, shape: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The points' order by cell `(N,)`, and where each cell starts in it `(cells + 1,)`."""
    num_points = points.shape[1]
    num_cells = shape[0] * shape[1] * shape[2]
    cells = np.empty(num_points, np.int64)
    start = np.zeros(num_cells + 1, np.int64)
    for i in range(num_points):
        cells[i] = _cell_of(points, i, corner, size, shape)
        start[cells[i] + 1] += 1
    following = np.empty(num_cells, np.int64)
    for cell in range(num_cells):
        following[cell] = start[cell]
        start[cell + 1] += start[cell]
    order = np.empty(num_points, np.int64)
    for i in range(num_points):
        order[following[cells[i]]] = i
        following[cells[i]] += 1
    return order, start


@numba.njit(cache=True, nogil=True)
def _copy_block(
    points: np.ndarray,
    start: np.ndarray,
    shape: tuple[int, int, int],
    cell: int,
    reach: int,
    block: np.ndarray,
) -> int:
    """Copy the points of the cells within `reach` of `cell` into `block` `(3, N)`; returns their number."""
    nx, ny, nz = shape
    x, y, z = cell % nx, cell // nx % ny, cell // (nx * ny)
    first, last = max(x - reach, 0), min(x + reach, nx - 1)
    num_block = 0
    for c in range(max(z - reach, 0), min(z + reach, nz - 1) + 1):
        for b in range(max(y - reach, 0), min(y + reach, ny - 1) + 1):
            row = (c * ny + b) * nx
            for i in range(start[row + first], start[row + last + 1]):
                block[0, num_block] = points[0, i]
                block[1, num_block] = points[1, i]
                block[2, num_block] = points[2, i]
                num_block += 1
    return num_block


@numba.njit(cache=True, nogil=True)
def _distance_to_border(
    place: tuple[float, float, float],
    corner: np.ndarray,
    size: float,
    shape: tuple[int, int, int],
    cell: int,
    reach: int,
) -> float:
    """How far it is at least to a point outside the block; infinite where the block is the whole grid."""
    nx, ny, _ = shape
    index = cell % nx, cell // nx % ny, cell // (nx * ny)
    border = np.inf
    for axis in range(3):
        low, high = index[axis] - reach, index[axis] + reach + 1
        if low > 0:
            border = min(border, place[axis] - (corner[axis] + low * size))
        if high < shape[axis]:
            border = min(border, corner[axis] + high * size - place[axis])
    return border - 1e-9 * size  # a point at a cell's border may be rounded to its other side


@numba.njit(cache=True, nogil=True)
def _limit_of_nearest(squared: np.ndarray, k: int, guess: float, work: np.ndarray) -> tuple[float, int]:
    """A limit that at least `k` values do not exceed, of which fewer than `k` are below it; and their number.

    Counts how many values do not exceed a guess, and guesses again, until the count is `k` or the limit is among a
    few values (or many equal ones); these are sorted. `work` is scratch space for one value more than there are.
    """
    num_values = len(squared)
    low, num_low, high, num_high = -1e-300, 0, np.inf, num_values
    limit = guess
    for attempt in range(16):
        count = 0
        for j in range(num_values):
            count += squared[j] <= limit
        if count == k:
            return limit, k
        if count < k:
            low, num_low = limit, count
        else:
            high, num_high = limit, count
        if num_high - num_low <= 12:
            break
        if high == np.inf:
            # On a surface the number grows with the square of the distance.
            limit *= min(4.0, 1.1 * (k + 0.5) / max(count, 1))
        elif attempt > 8:
            limit = (low + high) / 2
        else:
            limit = low + (high - low) * (k + 0.5 - num_low) / (num_high - num_low)
    num_between = 0
    for j in range(num_values):
        work[num_between] = squared[j]
        num_between += (squared[j] > low) & (squared[j] <= high)
    for i in range(1, num_between):  # by insertion: there are few, or they are equal
        value, j = work[i], i
        while j > 0 and work[j - 1] > value:
            work[j] = work[j - 1]
            j -= 1
        work[j] = value
    limit = work[k - 1 - num_low]
    num_within = k
    while num_within - num_low < num_between and work[num_within - num_low] == limit:
        num_within += 1
    return limit, num_within


@numba.njit(cache=True, nogil=True)
def _choose_nearest(squared: np.ndarray, k: int, limit: float, num_within: int, chosen: np.ndarray) -> None:
    """Write the places of the `k` smallest values into `chosen`; `num_within` of them do not exceed `limit`."""
    count = 0
    if num_within == k:
        for j in range(len(squared)):  # without a branch, which the processor could not predict
            chosen[count] = j
            count += squared[j] <= limit
        return
    num_ties = k
    for j in range(len(squared)):
        num_ties -= squared[j] < limit
    for j in range(len(squared)):
        if squared[j] < limit:
            chosen[count] = j
            count += 1
        elif squared[j] == limit and num_ties > 0:
            chosen[count] = j
            count += 1
            num_ties -= 1


@numba.njit(cache=True, nogil=True)
def _fit_plane(
    block: np.ndarray, chosen: np.ndarray, place: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Unit normal, towards the camera, of the plane through the chosen points of `block` around `place`."""
    x0, y0, z0 = place
    n = len(chosen)
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for j in chosen:
        # Relative to the central point: no cancellation far from the origin.
        x, y, z = block[0, j] - x0, block[1, j] - y0, block[2, j] - z0
        sx += x
        sy += y
        sz += z
        sxx += x * x
        sxy += x * y
        sxz += x * z
        syy += y * y
        syz += y * z
        szz += z * z
    return plane_normal(n, (sx, sy, sz), (sxx, sxy, sxz, syy, syz, szz), place)
