"""The z-buffer rasteriser: exact depth at pixel centres on one CPU core, compiled by numba."""

import math

import numba
import numpy as np
import torch
from torch import Tensor

from ljn.geometry.camera import Camera
from ljn.render import Fragments, Renderer, check_vertices


@numba.njit(cache=True, nogil=True)
def _rasterise(
    vertices: np.ndarray,
    faces: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    depth: np.ndarray,
    face_ids: np.ndarray | None,
    buffer: np.ndarray,
) -> None:
    """Write planar depth into `depth` `(H, W)`, which must be zero, and what is seen into `face_ids` `(H, W)`.

    `face_ids` may be None: numba then compiles a version without it. `buffer` is float64 scratch of the image's size,
    zero before and after.
    """
    height, width = depth.shape
    corners = np.empty((vertices.shape[0], 3))  # u, v, inverse depth
    for i in range(vertices.shape[0]):
        inverse = 1.0 / vertices[i, 2]
        corners[i, 0] = vertices[i, 0] * inverse * fx + cx
        corners[i, 1] = vertices[i, 1] * inverse * fy + cy
        corners[i, 2] = inverse
    # Faces turned away come last: what is before them then spares most of their work. Ids need the faces in their own
    # order, which decides between equally near ones.
    later = np.empty(faces.shape[0], np.int64)
    num_later = 0
    for f in range(faces.shape[0]):
        a, b, c = _corner(corners, faces[f, 0]), _corner(corners, faces[f, 1]), _corner(corners, faces[f, 2])
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if area > 0.0 and face_ids is None:
            later[num_later] = f
            num_later += 1
        elif area != 0.0:
            _draw_face(f, a, b, c, area, buffer, face_ids)
    for i in range(num_later):
        f = later[i]
        a, b, c = _corner(corners, faces[f, 0]), _corner(corners, faces[f, 1]), _corner(corners, faces[f, 2])
        _draw_face(f, a, b, c, 1.0, buffer, face_ids)

    left = min(max(math.floor(corners[:, 0].min()), 0), width)
    top = min(max(math.floor(corners[:, 1].min()), 0), height)
    right = min(math.ceil(corners[:, 0].max()), width - 1)
    bottom = min(math.ceil(corners[:, 1].max()), height - 1)
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            if buffer[v, u] > 0.0:
                depth[v, u] = 1.0 / buffer[v, u]
                buffer[v, u] = 0.0


@numba.njit(cache=True, nogil=True)
def _corner(corners: np.ndarray, i: int) -> tuple[float, float, float]:
    """Row `i`, as numbers: a view of it would be counted up and down."""
    return corners[i, 0], corners[i, 1], corners[i, 2]


@numba.njit(cache=True, nogil=True)
def _draw_face(
    face: int,
    a: tuple[float, float, float],
    b: tuple[float, float, float],
    c: tuple[float, float, float],
    area: float,
    buffer: np.ndarray,
    face_ids: np.ndarray | None,
) -> None:
    """Raise `buffer` to the inverse depth of a face with corners (u, v, inverse depth), wherever that is nearer.

    Inverse depth is affine in the image, so it is interpolated with the edge functions and the largest wins.
    Each edge function is computed from its two end points alone: neighbours get it with the opposite sign to
    the last bit, so that no pixel falls through a shared edge.
    """
    height, width = buffer.shape
    ua, va, wa = a
    ub, vb, wb = b
    uc, vc, wc = c
    u0 = max(math.ceil(min(ua, ub, uc)), 0)
    u1 = min(math.floor(max(ua, ub, uc)), width - 1)
    v0 = max(math.ceil(min(va, vb, vc)), 0)
    v1 = min(math.floor(max(va, vb, vc)), height - 1)
    sign = 1.0 if area > 0 else -1.0
    nearest = max(wa, wb, wc) * (1.0 + 1e-12)  # at least what rounding can make of any weighted mean
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            if nearest <= buffer[v, u]:
                continue
            ea = sign * ((ub - u) * (vc - v) - (uc - u) * (vb - v))
            eb = sign * ((uc - u) * (va - v) - (ua - u) * (vc - v))
            ec = sign * ((ua - u) * (vb - v) - (ub - u) * (va - v))
            if min(ea, min(eb, ec)) < 0.0:  # one jump, which is foretold more often than three
                continue
            total = ea + eb + ec
            if total == 0.0:  # a sliver thinner than rounding: its neighbours have this pixel
                continue
            w = (ea * wa + eb * wb + ec * wc) / total
            if w > buffer[v, u]:
                buffer[v, u] = w
                if face_ids is not None:
                    face_ids[v, u] = face


@numba.njit(cache=True, nogil=True)
def _write_barycentrics(
    vertices: np.ndarray,
    faces: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    face_ids: np.ndarray,
    barycentrics: np.ndarray,
) -> None:
    """Write the corners' weights into `barycentrics` `(H, W, 3)` wherever `face_ids` `(H, W)` is not -1."""
    height, width = face_ids.shape
    us, vs, inverse = np.empty(3), np.empty(3), np.empty(3)
    weights = np.empty(3)
    for v in range(height):
        for u in range(width):
            if face_ids[v, u] < 0:
                continue
            for k in range(3):
                x, y, z = vertices[faces[face_ids[v, u], k]]
                inverse[k] = 1.0 / z
                us[k] = x * inverse[k] * fx + cx
                vs[k] = y * inverse[k] * fy + cy
            for k in range(3):
                i, j = (k + 1) % 3, (k + 2) % 3
                edge = (us[i] - u) * (vs[j] - v) - (us[j] - u) * (vs[i] - v)
                weights[k] = edge * inverse[k]
            total = weights.sum()
            for k in range(3):
                barycentrics[v, u, k] = weights[k] / total


class ZBuffer(Renderer):
    """The `zbuffer` backend of `ljn.render.Renderer`; computes in float64, on the CPU, and returns there."""

    def __call__(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
        """See `ljn.render.Renderer`."""
        meshes, face_array = _as_arrays(vertices, faces)
        depth = np.zeros((len(meshes), camera.height, camera.width), np.float32)
        buffer = np.zeros((camera.height, camera.width))
        for mesh, image in zip(meshes, depth):
            _rasterise(mesh, face_array, camera.fx, camera.fy, camera.cx, camera.cy, image, None, buffer)
        return torch.from_numpy(depth)

    def fragments(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        """See `ljn.render.Renderer`; of faces that are equally near, the first is seen."""
        meshes, face_array = _as_arrays(vertices, faces)
        size = (len(meshes), camera.height, camera.width)
        depth, face_ids = np.zeros(size, np.float32), np.full(size, -1)
        barycentrics = np.zeros((*size, 3), np.float32)
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        buffer = np.zeros((camera.height, camera.width))
        for mesh, image, ids, weights in zip(meshes, depth, face_ids, barycentrics):
            _rasterise(mesh, face_array, *intrinsics, image, ids, buffer)
            _write_barycentrics(mesh, face_array, *intrinsics, ids, weights)
        return Fragments(*map(torch.from_numpy, (depth, face_ids, barycentrics)))


def _as_arrays(vertices: Tensor, faces: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """The meshes `(B, V, 3)` in float32 or float64 and the faces `(F, 3)` in int64, for numba."""
    check_vertices(vertices)
    on_cpu = vertices.detach().cpu()
    if on_cpu.dtype not in (torch.float32, torch.float64):
        on_cpu = on_cpu.double()
    meshes = np.ascontiguousarray(on_cpu.numpy())
    return meshes, np.ascontiguousarray(faces.cpu().numpy(), dtype=np.int64)
