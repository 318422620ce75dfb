"""A person with a look, drawn in colour."""

import numpy as np
import torch

from datamodules.rgb import kernels
from datamodules.rgb.look import Look
from datamodules.rgb.surface import Surface
from ljn.geometry.camera import Camera
from ljn.render import Renderer


def drawn(
    vertices: np.ndarray,
    surface: Surface,
    look: Look,
    intrinsics: np.ndarray,
    size: tuple[int, int],
    renderer: Renderer,
) -> tuple[np.ndarray, np.ndarray]:
    """A person, and where it is seen.

    Args:
        vertices: `(V, 3)`, metres, camera frame.
        surface: Of the body that they are of.
        look: Its look, and the light.
        intrinsics: `(4,)`: fx, fy, cx, cy in pixels of this image; its centre may lie outside.
        size: Height and width, pixels.
        renderer: One that gives fragments.

    Returns:
        `(h, w, 3)` float32, linear RGB, black around; and `(h, w)` uint8, 1 on the person.
    """
    height, width = size
    # A `Camera` has its principal point in its image. Sheared, the body looks the same to one that has.
    fx, fy, cx, cy = intrinsics
    camera = Camera(fx, fy, width / 2, height / 2, width, height)
    sheared = vertices.copy()
    sheared[:, 0] += vertices[:, 2] * ((cx - camera.cx) / fx)
    sheared[:, 1] += vertices[:, 2] * ((cy - camera.cy) / fy)
    normals = kernels.vertex_normals(vertices.astype(np.float32), surface.faces)
    facing = kernels.facing(sheared, surface.faces)
    surface = surface._replace(faces=surface.faces[facing], regions=surface.regions[facing])
    seen = renderer.fragments(torch.from_numpy(sheared)[None], torch.from_numpy(surface.faces), camera)
    face_ids = seen.face_ids[0].numpy()
    image = kernels.paint(
        *(face_ids, seen.barycentrics[0].numpy(), normals),
        *surface,
        *(
            look.colours,
            look.patterns,
            look.wear,
            look.gloss,
            look.cuts,
            look.lights,
            look.ambient,
            look.shift,
        ),
    )
    return image, (face_ids >= 0).astype(np.uint8)
