"""Triangle meshes: neighbours, smoothing, areas, volumes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ljn.body.build.requirements import import_scipy

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def edges(faces: Index) -> Index:
    """The directed edges `(3F, 2)` of faces `(F, 3)`: all first edges, then all second, then all third ones."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def neighbour_mean(faces: Index, vertices: Array | None = None) -> Any:
    """The sparse matrix `(V, V)` that takes the mean over each vertex's neighbours in a closed mesh.

    All count alike, or, where `vertices` `(V, 3)` are given, by their inverse distance there.
    """
    sparse = import_scipy("sparse")
    rows, columns = edges(faces).T  # closed: each edge stands here in both directions
    weights = np.ones(len(rows))
    if vertices is not None:
        weights = 1 / np.maximum(np.linalg.norm(vertices[rows] - vertices[columns], axis=1), 1e-4)
    matrix = sparse.csr_matrix((weights, (rows, columns)))
    return (sparse.diags(1 / np.asarray(matrix.sum(1)).ravel()) @ matrix).tocsr()


def smoothed(values: Array, mean: Any, passes: int) -> Array:
    """Values `(V, C)` after some passes, each half way to the mean of the neighbours."""
    for _ in range(passes):
        values = 0.5 * values + 0.5 * (mean @ values)
    return values


def face_normals(vertices: Array, faces: Index) -> Array:
    """`(..., F, 3)`: normals as long as twice their face's area, of meshes `(..., V, 3)`."""
    a, b, c = (vertices[..., faces[:, corner], :] for corner in range(3))
    return np.cross(b - a, c - a)


def vertex_areas(vertices: Array, faces: Index) -> Array:
    """`(V,)`, square metres: a third of the faces around each vertex."""
    areas = np.linalg.norm(face_normals(vertices, faces), axis=-1) / 6
    return np.bincount(faces.ravel(), np.repeat(areas, 3), minlength=len(vertices)).astype(np.float64)


def volume(vertices: Array, faces: Index) -> Array:
    """`(...)`, cubic metres: what closed meshes `(..., V, 3)` enclose, positive if faces are seen from outside."""
    corner = vertices[..., faces[:, 0], :]
    return np.einsum("...fd,...fd->...", corner, face_normals(vertices, faces)) / 6
