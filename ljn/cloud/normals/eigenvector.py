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
    xx, xy, xz, yy, yz, zz, spread, cosine = scaled(xx, xy, xz, yy, yz, zz)
    return null_vector(xx, xy, xz, yy, yz, zz, smallest_eigenvalue(spread, cosine))


# The parts of the solution. Those without a branch, so that a loop over many matrices is compiled to vector
# instructions, divide by zero where the quotient is not used.


@numba.njit(cache=True, nogil=True, error_model="numpy")
def scaled(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """The matrix at a trace of 1, and the two numbers that its eigenvalues follow from."""
    trace = xx + yy + zz
    scale = 1.0 / trace if trace > 0.0 else 0.0
    equal = 0.0 if trace > 0.0 else 1.0 / 3.0  # a matrix of zeros has equal eigenvalues, at a trace of 1 too
    xx, yy, zz = xx * scale + equal, yy * scale + equal, zz * scale + equal
    xy, xz, yz = xy * scale, xz * scale, yz * scale
    a, b, c = xx - 1.0 / 3.0, yy - 1.0 / 3.0, zz - 1.0 / 3.0
    spread = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    cosine = determinant / (2.0 * spread * spread * spread) if spread > 1e-12 else 0.0
    cosine = cosine if cosine < 1.0 else 1.0
    cosine = cosine if cosine > -1.0 else -1.0
    return xx, xy, xz, yy, yz, zz, spread, cosine


@numba.njit(cache=True, nogil=True)
def smallest_eigenvalue(spread: float, cosine: float) -> float:
    """The smallest eigenvalue of a matrix that `scaled` gave with these two."""
    return 1.0 / 3.0 + 2.0 * spread * math.cos((math.acos(cosine) + 2.0 * math.pi) / 3.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def null_vector(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, eigenvalue: float
) -> tuple[float, float, float]:
    """Unit eigenvector of an eigenvalue of a matrix whose trace is 1; zeros where it is not unique."""
    a, b, c = xx - eigenvalue, yy - eigenvalue, zz - eigenvalue
    x0, y0, z0 = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    x1, y1, z1 = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    x2, y2, z2 = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    best, second = x0 * x0 + y0 * y0 + z0 * z0, x1 * x1 + y1 * y1 + z1 * z1
    third = x2 * x2 + y2 * y2 + z2 * z2
    x, y, z = (x1, y1, z1) if second > best else (x0, y0, z0)
    best = second if second > best else best
    x, y, z = (x2, y2, z2) if third > best else (x, y, z)
    best = third if third > best else best
    # `best` is the squared gap between the two smallest eigenvalues, at a trace of 1. The arc cosine knows these
    # to 1e-8 where they agree (points on a line), so that a smaller gap says nothing.
    scale = 1.0 / math.sqrt(best) if best >= 1e-12 else 0.0
    return x * scale, y * scale, z * scale


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
