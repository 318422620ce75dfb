"""Ray casting with Open3D: an independent reference for the rasterisers."""

import numpy as np
import torch
from torch import Tensor

from ljn.geometry.camera import Camera
from ljn.optional import import_open3d
from ljn.render import check_vertices


class RayCaster:
    """The `open3d` backend of `ljn.render.Renderer`; on the CPU."""

    def __init__(self) -> None:
        self._open3d = import_open3d()

    def __call__(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
        """See `ljn.render.Renderer`."""
        check_vertices(vertices)
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        # Directions with z = 1: the hit parameter then is planar depth.
        directions = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1
        )
        rays = np.concatenate([np.zeros_like(directions), directions], -1).astype(np.float32)
        tensor = self._open3d.core.Tensor
        face_tensor = tensor.from_numpy(np.ascontiguousarray(faces.cpu().numpy(), dtype=np.uint32))
        depth = np.zeros((len(vertices), camera.height, camera.width), np.float32)
        for mesh, image in zip(vertices.detach().cpu().float().numpy(), depth):
            scene = self._open3d.t.geometry.RaycastingScene()
            scene.add_triangles(tensor.from_numpy(np.ascontiguousarray(mesh)), face_tensor)
            hit = scene.cast_rays(tensor.from_numpy(rays))["t_hit"].numpy()
            image[:] = np.where(np.isfinite(hit), hit, 0.0)
        return torch.from_numpy(depth)
