"""The thesis's renderer: pyrender through EGL, made exact at pixel centres."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ljn.geometry.camera import Camera
from ljn.optional import import_pyrender
from ljn.render import Renderer, check_vertices

# pyrender's axes are OpenGL's: y up, looking along -z.
_GL_FROM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])


class PyRender(Renderer):
    """The `pyrender` backend of `ljn.render.Renderer`; depth alone, returned on the CPU.

    The GL context is made on first use, in the process that uses it: a context that is older than a fork
    deadlocks in the child. One renderer a process; data workers that use it must be spawned.

    Back faces are culled, which pyrender's flags do not change in this mode: it is for closed meshes whose faces
    look outwards.

    Args:
        near_m: Depth of the near plane, metres; nothing nearer is drawn.
        far_m: Depth of the far plane, metres.
    """

    def __init__(self, near_m: float = 0.1, far_m: float = 10.0) -> None:
        self._pyrender = import_pyrender()
        self.near_m = near_m
        self.far_m = far_m
        self._renderer: Any = None

    def __call__(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
        """See `ljn.render.Renderer`."""
        check_vertices(vertices)
        pyrender = self._pyrender
        renderer = self._offscreen(camera)
        # GL samples at half-integer window coordinates, our pixel centres are integers.
        gl_camera = pyrender.IntrinsicsCamera(
            camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, znear=self.near_m, zfar=self.far_m
        )
        flags = pyrender.RenderFlags
        depth = np.zeros((len(vertices), camera.height, camera.width), np.float32)
        face_array = faces.cpu().numpy().astype(np.uint32)
        for mesh, image in zip(vertices.detach().cpu().float().numpy(), depth):
            scene = pyrender.Scene()
            primitive = pyrender.Primitive(positions=mesh, indices=face_array, mode=4)
            node = scene.add(pyrender.Mesh([primitive]))
            scene.add(gl_camera, pose=_GL_FROM_CAMERA)
            # SEG turns multisampling off, which would return the depth of a sample beside the pixel's centre.
            image[:] = renderer.render(
                scene, flags=flags.DEPTH_ONLY | flags.SEG, seg_node_map={node: (255, 255, 255)}
            )
        return torch.from_numpy(depth)

    def _offscreen(self, camera: Camera) -> Any:
        """The offscreen renderer of this process, in the camera's size."""
        if self._renderer is None:
            try:
                self._renderer = self._pyrender.OffscreenRenderer(camera.width, camera.height)
            except Exception as error:  # PyOpenGL raises a type of its own for each way to have no EGL
                raise ImportError(
                    f"pyrender cannot make an EGL context ({error}). It needs the system libraries libegl1, "
                    "libgl1 and libxrender1 and a driver (Mesa's will do); or do without it: "
                    "data.synthesis.renderer=zbuffer"
                ) from error
        self._renderer.viewport_width, self._renderer.viewport_height = camera.width, camera.height
        return self._renderer
