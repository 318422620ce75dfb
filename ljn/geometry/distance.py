"""How far points lie from a mesh."""

import math

import numba
import numpy as np


def distances_to_mesh(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distance of each point to the nearest place on a mesh.

    Args:
        points: `(N, 3)`, metres.
        vertices: `(V, 3)`, metres, same frame.
        faces: `(F, 3)`, vertex indices.

    Returns:
        `(N,)` float64, metres.
    """
    triangles = np.asarray(vertices, np.float64)[faces]
    centres = triangles.mean(1)
    radii = np.linalg.norm(triangles - centres[:, None], axis=-1).max(1)
    return _distances(np.asarray(points, np.float64), triangles, centres, radii)


@numba.njit(cache=True, nogil=True)
def _distances(
    points: np.ndarray, triangles: np.ndarray, centres: np.ndarray, radii: np.ndarray
) -> np.ndarray:
    distances = np.full(len(points), np.inf)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for f in range(len(triangles)):
            dx, dy, dz = centres[f, 0] - x, centres[f, 1] - y, centres[f, 2] - z
            reach = distances[i] + radii[f]
            if dx * dx + dy * dy + dz * dz < reach * reach:
                distances[i] = min(distances[i], math.sqrt(_square(triangles[f], x, y, z)))
    return distances


@numba.njit(cache=True, nogil=True)
def _square(triangle: np.ndarray, x: float, y: float, z: float) -> float:
    """Squared distance of a point to a triangle: the least |a + s ab + t ac|^2 with s, t >= 0 and s + t <= 1."""
    aa = ab = ac = bb = bc = cc = 0.0
    for axis, origin in enumerate((x, y, z)):
        a = triangle[0, axis] - origin
        b, c = triangle[1, axis] - triangle[0, axis], triangle[2, axis] - triangle[0, axis]
        aa += a * a
        ab += a * b
        ac += a * c
        bb += b * b
        bc += b * c
        cc += c * c
    determinant = bb * cc - bc * bc
    s, t = bc * ac - cc * ab, bc * ab - bb * ac
    if determinant > 0.0 and s >= 0.0 and t >= 0.0 and s + t <= determinant:
        return max(aa + (s * ab + t * ac) / determinant, 0.0)
    opposite = _on_edge(aa + 2 * ab + bb, ac - ab + bc - bb, bb - 2 * bc + cc)
    return max(min(_on_edge(aa, ab, bb), _on_edge(aa, ac, cc), opposite), 0.0)


@numba.njit(cache=True, nogil=True)
def _on_edge(start: float, slope: float, length: float) -> float:
    """The least |p + x d|^2 with 0 <= x <= 1, from |p|^2, p d and |d|^2."""
    x = min(max(-slope / length, 0.0), 1.0) if length > 0.0 else 0.0
    return start + x * (2 * slope + x * length)
