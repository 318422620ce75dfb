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


@numba.njit(cache=True, nogil=True)
def towards_camera(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit vector from a point to the camera; (0, 0, -1) at the camera itself."""
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, -1.0
    return -x / length, -y / length, -z / length


@numba.njit(cache=True, nogil=True)
def plane_normal(
    n: int,
    sums: tuple[float, float, float],
    products: tuple[float, float, float, float, float, float],
    place: tuple[float, float, float],
) -> tuple[float, float, float]:
    """Unit normal, towards the camera, of the plane that fits points best; where none does, the camera's direction.

    Args:
        n: Number of points.
        sums: Of their x, y and z relative to `place`.
        products: Sums of xx, xy, xz, yy, yz and zz.
        place: The point whose normal it is, metres, camera frame.
    """
    sx, sy, sz = sums
    sxx, sxy, sxz, syy, syz, szz = products
    x0, y0, z0 = place
    nx, ny, nz = smallest_eigenvector(
        sxx / n - sx * sx / n / n,
        sxy / n - sx * sy / n / n,
        sxz / n - sx * sz / n / n,
        syy / n - sy * sy / n / n,
        syz / n - sy * sz / n / n,
        szz / n - sz * sz / n / n,
    )
    if nx == 0.0 and ny == 0.0 and nz == 0.0:
        return towards_camera(x0, y0, z0)
    if nx * x0 + ny * y0 + nz * z0 > 0.0:
        return -nx, -ny, -nz
    return nx, ny, nz
