"""The direction in which points spread least: the normal of the plane that fits them best."""

import math

import numba


@numba.njit(cache=True, nogil=True)
def smallest_eigenvector(
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
