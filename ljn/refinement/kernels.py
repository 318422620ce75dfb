"""What a refinement does most, on the CPU, compiled by numba; on other devices tensors do the same, to rounding."""

import numba
import numpy as np

from ljn.body.skeleton import NUM_JOINTS, PARENTS

_PARENTS = np.array(PARENTS)


@numba.njit(cache=True, nogil=True, fastmath=True)
def nearest_vertices(
    asked: np.ndarray, offered: np.ndarray, is_facing: np.ndarray, index: np.ndarray
) -> None:
    """Write the facing vertex whose product is least, of each point, into `index` `(B, N)`; 0 where none faces.

    `asked` is `(B, N, C)`, `offered` `(B, U, C)`; of equal products, the first counts.
    """
    num_vertices, num_columns = offered.shape[1:]
    kept = np.empty(num_vertices, np.int64)
    columns = np.empty((num_columns, num_vertices), asked.dtype)
    costs = np.empty(num_vertices, asked.dtype)
    for b in range(asked.shape[0]):
        count = 0
        for u in range(num_vertices):
            if is_facing[b, u]:
                kept[count] = u
                columns[:, count] = offered[b, u]
                count += 1
        if count == 0:
            index[b] = 0
            continue
        for n in range(asked.shape[1]):
            # The least first, then its place: half the time of one loop with both.
            costs[:count] = 0
            for c in range(num_columns - 1):
                factor = asked[b, n, c]
                for u in range(count):
                    costs[u] += factor * columns[c, u]
            least = costs.dtype.type(np.inf)
            for u in range(count):
                costs[u] += asked[b, n, num_columns - 1] * columns[num_columns - 1, u]
                least = min(least, costs[u])
            place = 0
            while place < count - 1 and costs[place] > least:
                place += 1
            index[b, n] = kept[place]


@numba.njit(cache=True, nogil=True, fastmath=True)
def jacobian_rows(
    index: np.ndarray,
    directions: np.ndarray,
    unposed: np.ndarray,
    blended: np.ndarray,
    rotations: np.ndarray,
    offsets: np.ndarray,
    joints: np.ndarray,
    joint_shapes: np.ndarray,
    weights: np.ndarray,
    shapes: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write `BodySurface.rows` into `out` `(B, M, 85)`."""
    num_betas = shapes.shape[2]
    share = np.empty(NUM_JOINTS, out.dtype)  # of the vertex, that a joint and those below it carry
    arm = np.empty((NUM_JOINTS, 3), out.dtype)
    local = np.empty(3, out.dtype)
    for b in range(index.shape[0]):
        for m in range(index.shape[1]):
            u = index[b, m]
            d0, d1, d2 = directions[b, m, 0], directions[b, m, 1], directions[b, m, 2]
            x0, x1, x2 = unposed[b, u, 0], unposed[b, u, 1], unposed[b, u, 2]
            row = out[b, m]
            share[:] = 0
            arm[:] = 0
            for j in range(3):
                local[j] = d0 * blended[b, u, 0, j] + d1 * blended[b, u, 1, j] + d2 * blended[b, u, 2, j]
            for beta in range(num_betas):
                row[3 * NUM_JOINTS + beta] = (
                    local[0] * shapes[u, 0, beta]
                    + local[1] * shapes[u, 1, beta]
                    + local[2] * shapes[u, 2, beta]
                )
            for k in range(NUM_JOINTS):
                weight = weights[u, k]
                if weight > 0:
                    share[k] = weight
                    for i in range(3):
                        turn = rotations[b, k, i]
                        arm[k, i] = weight * (turn[0] * x0 + turn[1] * x1 + turn[2] * x2 + offsets[b, k, i])
                    for beta in range(num_betas):
                        row[3 * NUM_JOINTS + beta] += weight * (
                            d0 * joint_shapes[b, k, 0, beta]
                            + d1 * joint_shapes[b, k, 1, beta]
                            + d2 * joint_shapes[b, k, 2, beta]
                        )
            for k in range(NUM_JOINTS - 1, 0, -1):
                if share[k] > 0:
                    parent = _PARENTS[k]
                    share[parent] += share[k]
                    for i in range(3):
                        arm[parent, i] += arm[k, i]
            for k in range(NUM_JOINTS):
                if share[k] > 0:
                    a0 = arm[k, 0] - share[k] * joints[b, k, 0]
                    a1 = arm[k, 1] - share[k] * joints[b, k, 1]
                    a2 = arm[k, 2] - share[k] * joints[b, k, 2]
                    c0, c1, c2 = a1 * d2 - a2 * d1, a2 * d0 - a0 * d2, a0 * d1 - a1 * d0
                    for j in range(3):
                        turned = rotations[b, k, 0, j] * c0 + rotations[b, k, 1, j] * c1
                        row[3 * k + j] = turned + rotations[b, k, 2, j] * c2
                else:
                    row[3 * k : 3 * k + 3] = 0
            row[3 * NUM_JOINTS + num_betas :] = directions[b, m]


@numba.njit(cache=True, nogil=True)
def nearest_pixels(is_body: np.ndarray, index: np.ndarray) -> None:
    """Write each pixel's nearest pixel of the body, as row * P + column, into `index` `(B, P, P)`; -1 without a body.

    `is_body` is `(B, P, P)`. Exact: the nearest of each column, then the nearest of those.
    """
    size = is_body.shape[1]
    rows = np.empty((size, size), np.int64)
    for b in range(is_body.shape[0]):
        for column in range(size):
            last = -1
            for row in range(size):
                last = row if is_body[b, row, column] else last
                rows[row, column] = last
            following = -1
            for row in range(size - 1, -1, -1):
                following = row if is_body[b, row, column] else following
                before = rows[row, column]
                if following >= 0 and (before < 0 or following - row < row - before):
                    rows[row, column] = following
        for row in range(size):
            for column in range(size):
                best, nearest = 4 * size * size, -1
                for step in range(size):
                    if step * step >= best:
                        break
                    for other in (column - step, column + step):
                        if 0 <= other < size and rows[row, other] >= 0:
                            squared = step * step + (rows[row, other] - row) ** 2
                            if squared < best:
                                best, nearest = squared, rows[row, other] * size + other
                index[b, row, column] = nearest
