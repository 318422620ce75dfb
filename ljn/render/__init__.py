"""Renderers behind one interface; each backend is imported when it is first asked for.

`zbuffer` (numba) is the default on a CPU and needs neither GL nor a display. `torch` is the default on an
accelerator and never leaves it. `pyrender` is the thesis's way, through EGL. `open3d` casts rays and is an
independent reference. All sample at integer pixel centres.
"""

import math
from abc import ABC, abstractmethod
from importlib import import_module
from typing import NamedTuple

import torch
from torch import Tensor

from ljn.geometry.camera import Camera


class Fragments(NamedTuple):
    """What is seen at each pixel.

    Attributes:
        depth: `(B, H, W)` float32, metres along the optical axis; 0 is background.
        face_ids: `(B, H, W)` int64, the face that is seen; -1 is background.
        barycentrics: `(B, H, W, 3)` float32, the weights of that face's corners whose sum is the point in space
            that is seen (perspective-correct); 0 in the background.
    """

    depth: Tensor
    face_ids: Tensor
    barycentrics: Tensor


class Renderer(ABC):
    """What a backend offers: meshes in, images out.

    `torch` computes and returns on the vertices' device; all others return tensors on the CPU.
    """

    @abstractmethod
    def __call__(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
        """Depth images of a batch of meshes that share their faces.

        Args:
            vertices: `(B, V, 3)`, metres, camera frame, all in front of the camera.
            faces: `(F, 3)`, integer vertex indices.
            camera: The camera of the whole batch.

        Returns:
            `(B, H, W)` float32, metres along the optical axis at integer pixel centres; 0 is background.

        Raises:
            ValueError: A vertex is not finite or not in front of the camera.
        """

    def fragments(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        """Depth images and, at each pixel, the face that is seen and where on it; arguments as in a call.

        Raises:
            ValueError: A vertex is not finite or not in front of the camera.
            NotImplementedError: This backend draws depth alone.
        """
        raise NotImplementedError(
            f"{type(self).__name__} draws depth alone; face ids and barycentrics come from the renderers "
            "auto, zbuffer, torch and open3d"
        )


class _ByDevice(Renderer):
    """The renderer `auto`: `zbuffer` for vertices on the CPU, `torch` for those on an accelerator."""

    def __init__(self) -> None:
        self._backends: dict[str, Renderer] = {}

    def __call__(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
        return self.backend(vertices.device)(vertices, faces, camera)

    def fragments(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        return self.backend(vertices.device).fragments(vertices, faces, camera)

    def backend(self, device: torch.device) -> Renderer:
        """The renderer of vertices on that device."""
        name = "zbuffer" if device.type == "cpu" else "torch"
        if name not in self._backends:
            self._backends[name] = get_renderer(name)
        return self._backends[name]


_BACKENDS = {
    "auto": "ljn.render:_ByDevice",
    "zbuffer": "ljn.render.zbuffer:ZBuffer",
    "torch": "ljn.render.rasterizer:TorchRasterizer",
    "pyrender": "ljn.render.opengl:PyRender",
    "open3d": "ljn.render.raycast:RayCaster",
}
RENDERERS = tuple(_BACKENDS)


def get_renderer(name: str = "auto") -> Renderer:
    """The renderer of that name, freshly built; `auto` takes the fastest for the device of each call's vertices.

    Raises:
        ValueError: No such renderer.
        ImportError: The backend's package or its system libraries are missing.
    """
    if name not in RENDERERS:
        raise ValueError(f"renderer: expected one of {', '.join(RENDERERS)}, got '{name}'")
    module, _, attribute = _BACKENDS[name].partition(":")
    return getattr(import_module(module), attribute)()


def check_vertices(vertices: Tensor) -> None:
    """Raise a `ValueError` unless `vertices` `(B, V, 3)` are finite and in front of the camera."""
    if vertices.ndim != 3 or vertices.shape[-1] != 3:
        raise ValueError(f"vertices: expected (B, V, 3), got {tuple(vertices.shape)}")
    if not vertices.numel():
        return
    # One transfer from the device for all answers; NaN comes through.
    *ends, nearest = torch.stack([*vertices.aminmax(), vertices[..., 2].amin()]).tolist()
    if not all(map(math.isfinite, ends)):
        raise ValueError("vertices: NaN or infinite values; check the pose, the shape and the translation")
    if nearest <= 0:
        raise ValueError(
            f"vertices: the nearest has a depth of {nearest:.3f} m; the whole mesh must lie in front of "
            "the camera (camera frame: z forward, metres)"
        )
