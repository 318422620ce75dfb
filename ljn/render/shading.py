"""Smoothly shaded pictures of meshes, without a display."""

import numpy as np
import torch

from ljn.geometry.camera import Camera
from ljn.render import get_renderer

SKIN = (0.80, 0.72, 0.66)
# Towards the light, in the camera frame: from behind the camera's left shoulder.
_LIGHT = np.array([-0.25, -0.35, -0.90])


def shade_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    colour: tuple[float, float, float] | np.ndarray = SKIN,
    background: float | np.ndarray = 1.0,
) -> np.ndarray:
    """A picture of a mesh, smoothly shaded.

    Args:
        vertices: `(V, 3)`, metres, camera frame, in front of the camera.
        faces: `(F, 3)`, vertex indices, outwards counter-clockwise.
        camera: The camera.
        colour: RGB in 0-1, one or `(F, 3)`, one for each face.
        background: Where there is no mesh: a grey value (NaN marks these pixels), or an image `(H, W, 3)`.

    Returns:
        `(H, W, 3)` RGB in 0-1.
    """
    normals = vertex_normals(vertices, faces)
    seen = get_renderer("zbuffer").fragments(
        torch.from_numpy(np.ascontiguousarray(vertices, dtype=np.float64))[None], torch.tensor(faces), camera
    )
    face_ids, shares = seen.face_ids[0].numpy(), seen.barycentrics[0].numpy()
    is_mesh = face_ids >= 0
    face_ids, shares = face_ids[is_mesh], shares[is_mesh]  # (S,), (S, 3)
    normal = (normals[faces[face_ids]] * shares[..., None]).sum(-2)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    light = np.clip(normal @ (_LIGHT / np.linalg.norm(_LIGHT)), 0, 1)
    albedo = np.broadcast_to(np.asarray(colour, np.float64), (len(faces), 3))[face_ids]
    picture = np.empty((*is_mesh.shape, 3))
    picture[:] = background
    picture[is_mesh] = albedo * (0.25 + 0.75 * light)[..., None]
    return picture


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Outward normals `(V, 3)` float64, of a length of no meaning: the sums of the faces' around each vertex.

    Args:
        vertices: `(V, 3)`.
        faces: `(F, 3)`, vertex indices, outwards counter-clockwise.
    """
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals)
    return normals
