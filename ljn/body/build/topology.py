"""Decimating a closed, left-right symmetric mesh so that it stays closed, symmetric and of the same genus."""

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ljn.body.build.requirements import import_scipy

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LONG_EDGES = 2.0
"""Weight of the squared squared edge length beside the quadric error: keeps flat areas from emptying."""
_LARGEST_TURN = 0.35
"""Cosine of the most that a collapse may turn a face."""
_SLIVER = 0.12
"""Least ratio of twice a face's area to its longest edge's square."""
_ON_PLANE = 1e-6
"""Metres: vertices nearer to the plane x = 0 lie on it."""


@dataclass(frozen=True)
class Topology:
    """The triangles of every embedded body."""

    kept: Index  # `(V,)`, which of the source's vertices these are, from the head down
    faces: Index  # `(F, 3)`, indices into `kept`, counter-clockwise from outside; the second half mirrors the first
    mirror: Index  # `(V,)`, each vertex's left-right counterpart


def mirror_vertices(vertices: Array) -> Index:
    """Each vertex's counterpart `(N,)` across the plane x = 0 in a symmetric mesh `(N, 3)`.

    Raises:
        ValueError: The vertices do not come in pairs.
    """
    mirror = import_scipy("spatial").cKDTree(vertices).query(vertices * [-1, 1, 1])[1]
    if not np.array_equal(mirror[mirror], np.arange(len(vertices))):
        raise ValueError(
            "vertices: expected mirror pairs across x = 0, but not every vertex has its own partner"
        )
    return mirror


def symmetrised(vertices: Array, mirror: Index) -> Array:
    """The exactly symmetric mean of meshes `(..., V, 3)` and their mirror images."""
    return (vertices + vertices[..., mirror, :] * [-1.0, 1.0, 1.0]) / 2


def decimate_symmetric(vertices: Array, polygons: list[list[int]], num_faces: int) -> Topology:
    """A closed symmetric mesh, reduced by collapsing edges; its vertices are a subset of the source's.

    One half (x >= 0) is decimated with the midline locked, and mirrored. A collapse keeps a closed mesh closed
    and its genus: genus 0 gives V = F / 2 + 2.

    Args:
        vertices: `(N, 3)`, metres, symmetric about x = 0.
        polygons: Triangles and quadrangles, none across the plane x = 0.
        num_faces: F; a collapse takes two faces of each half, so it must differ from the number of triangles by
            a multiple of four.

    Returns:
        The smaller mesh.

    Raises:
        ValueError: `num_faces` cannot be reached exactly, or not with a sound mesh.
    """
    # Rounded, so that rounding errors of other machines do not change the order of collapses.
    vertices = np.round(vertices, 7)
    left = [polygon for polygon in polygons if vertices[polygon, 0].min() > -_ON_PLANE]
    ids, half = np.unique(np.array(_triangles(vertices, left)), return_inverse=True)
    half = ids[_HalfMesh(vertices[ids], half.reshape(-1, 3)).decimate(num_faces // 2)]

    partner = mirror_vertices(vertices)
    kept, faces = np.unique(np.concatenate([half, partner[half][:, ::-1]]), return_inverse=True)
    order = np.argsort(-vertices[kept, 1], kind="stable")
    place = np.argsort(order)
    position = np.full(len(vertices), -1)
    position[kept[order]] = np.arange(len(kept))
    return Topology(kept[order], place[faces.reshape(-1, 3)], position[partner[kept[order]]])


def _triangles(vertices: Array, polygons: list[list[int]]) -> list[list[int]]:
    """Quadrangles cut along their shorter diagonal."""
    triangles = []
    for polygon in polygons:
        if len(polygon) == 3:
            triangles.append(polygon)
            continue
        a, b, c, d = polygon
        if np.linalg.norm(vertices[a] - vertices[c]) <= np.linalg.norm(vertices[b] - vertices[d]):
            triangles += [[a, b, c], [a, c, d]]
        else:
            triangles += [[a, b, d], [b, c, d]]
    return triangles


class _HalfMesh:
    """Edge collapses by quadric error (Garland and Heckbert 1997), onto one of the edge's two ends."""

    def __init__(self, vertices: Array, faces: Index) -> None:
        self.vertices = vertices
        self.faces: list[list[int]] = faces.tolist()
        self.faces_of: list[set[int]] = [set() for _ in vertices]
        self.is_locked = np.abs(vertices[:, 0]) < _ON_PLANE
        self.version = [0] * len(vertices)
        self.quadrics = np.zeros((len(vertices), 4, 4))
        for number, face in enumerate(self.faces):
            normal = self._normal(face)
            twice_area = float(np.linalg.norm(normal)) + 1e-18
            plane = np.append(normal, -normal @ vertices[face[0]]) / twice_area
            for vertex in face:
                self.faces_of[vertex].add(number)
                self.quadrics[vertex] += np.outer(plane, plane) * twice_area / 2
        self.heap: list[tuple[float, int, int, int, int]] = []

    def decimate(self, num_faces: int) -> Index:
        """The faces `(num_faces, 3)` that are left when as many collapses as needed are done."""
        for vertex in range(len(self.vertices)):
            for neighbour in self._neighbours(vertex):
                self._push(vertex, neighbour)
        alive = set(range(len(self.faces)))
        if num_faces > len(alive) or (len(alive) - num_faces) % 2:
            raise ValueError(
                f"num_faces: expected fewer than the {2 * len(alive)} triangles by a multiple of four, "
                f"got {2 * num_faces}"
            )
        while len(alive) > num_faces:
            if not self.heap:
                raise ValueError(
                    f"num_faces: expected at least the {2 * len(alive)} that sound collapses lead to, "
                    f"got {2 * num_faces}"
                )
            _, gone, kept, gone_version, kept_version = heapq.heappop(self.heap)
            if (self.version[gone], self.version[kept]) != (gone_version, kept_version):
                continue
            if self._may_collapse(gone, kept):
                alive -= self._collapse(gone, kept)
        return np.array([self.faces[number] for number in sorted(alive)])

    def _normal(self, face: list[int]) -> Array:
        a, b, c = self.vertices[face]
        return np.cross(b - a, c - a)

    def _neighbours(self, vertex: int) -> set[int]:
        return {other for number in self.faces_of[vertex] for other in self.faces[number]} - {vertex}

    def _push(self, gone: int, kept: int) -> None:
        if self.is_locked[gone]:
            return
        point = np.append(self.vertices[kept], 1.0)
        edge = self.vertices[kept] - self.vertices[gone]
        cost = float(
            point @ (self.quadrics[gone] + self.quadrics[kept]) @ point + _LONG_EDGES * (edge @ edge) ** 2
        )
        heapq.heappush(self.heap, (float(f"{cost:.6e}"), gone, kept, self.version[gone], self.version[kept]))

    def _may_collapse(self, gone: int, kept: int) -> bool:
        shared = self.faces_of[gone] & self.faces_of[kept]
        if len(shared) != 2 or len(self._neighbours(gone) & self._neighbours(kept)) != 2:
            return False  # the mesh would be pinched
        for number in self.faces_of[gone] - shared:
            before = self.faces[number]
            after = [kept if vertex == gone else vertex for vertex in before]
            old, new = self._normal(before), self._normal(after)
            size = float(np.linalg.norm(new))
            corners = self.vertices[after]
            longest = float(((corners - np.roll(corners, 1, axis=0)) ** 2).sum(1).max())
            if old @ new <= _LARGEST_TURN * np.linalg.norm(old) * size or size <= _SLIVER * longest:
                return False
        return True

    def _collapse(self, gone: int, kept: int) -> set[int]:
        """Moves `gone` onto `kept`; returns the two faces that vanish."""
        shared = self.faces_of[gone] & self.faces_of[kept]
        for number in shared:
            for vertex in self.faces[number]:
                self.faces_of[vertex].discard(number)
        for number in self.faces_of[gone]:
            self.faces[number] = [kept if vertex == gone else vertex for vertex in self.faces[number]]
        self.faces_of[kept] |= self.faces_of[gone]
        self.faces_of[gone] = set()
        self.quadrics[kept] += self.quadrics[gone]
        self.version[gone] = -1
        self.version[kept] += 1
        for neighbour in self._neighbours(kept):
            self._push(neighbour, kept)
            self._push(kept, neighbour)
        return shared
