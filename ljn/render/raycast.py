"""Ray casting with Open3D: an independent reference for the rasterisers."""

import numpy as np
import torch
from torch import Tensor

from ljn.geometry.camera import Camera
from ljn.optional import import_open3d
from ljn.render import Fragments, Renderer, check_vertices

_NO_FACE = np.iinfo(np.uint32).max


class RayCaster(Renderer):
    """The `open3d` backend of `ljn.render.Renderer`; computes in float32, on the CPU, and returns there."""

    def __init__(self) -> None:
        self._open3d = import_open3d()

    def __call__(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
        """See `ljn.render.Renderer`."""
        return self.fragments(vertices, faces, camera).depth

    def fragments(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        """See `ljn.render.Renderer`; of faces that are equally near, any may be seen."""
        check_vertices(vertices)
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        # Directions with z = 1: the hit parameter then is planar depth.
        directions = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1
        )
        rays = np.concatenate([np.zeros_like(directions), directions], -1).astype(np.float32)
        tensor = self._open3d.core.Tensor
        face_tensor = tensor.from_numpy(np.ascontiguousarray(faces.cpu().numpy(), dtype=np.uint32))
        size = (len(vertices), camera.height, camera.width)
        depth, face_ids = np.zeros(size, np.float32), np.full(size, -1)
        barycentrics = np.zeros((*size, 3), np.float32)
        for i, mesh in enumerate(vertices.detach().cpu().float().numpy()):
            scene = self._open3d.t.geometry.RaycastingScene()
            scene.add_triangles(tensor.from_numpy(np.ascontiguousarray(mesh)), face_tensor)
            answer = scene.cast_rays(tensor.from_numpy(rays))
            seen = answer["primitive_ids"].numpy()
            is_hit = seen != _NO_FACE
            depth[i][is_hit] = answer["t_hit"].numpy()[is_hit]
            face_ids[i][is_hit] = seen[is_hit]
            # Weights of the second and the third corner.
            second_third = answer["primitive_uvs"].numpy()[is_hit]
            barycentrics[i][is_hit] = np.concatenate(
                [1 - second_third.sum(-1, keepdims=True), second_third], -1
            )
        return Fragments(*map(torch.from_numpy, (depth, face_ids, barycentrics)))
