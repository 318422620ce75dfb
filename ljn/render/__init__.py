"""Depth renderers behind one interface; each backend is imported when it is first asked for.

`zbuffer` (numba) is the default on a CPU and needs neither GL nor a display. `pyrender` is the thesis's way, through
EGL. `open3d` casts rays and is an independent reference.
"""

from importlib import import_module
from typing import Protocol

from torch import Tensor

from ljn.geometry.camera import Camera


class Renderer(Protocol):
    """What a backend offers: meshes in, depth images out."""

    def __call__(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
        """Render a batch of meshes that share their faces.

        Args:
            vertices: `(B, V, 3)`, metres, camera frame, all in front of the camera.
            faces: `(F, 3)`, integer vertex indices.
            camera: The camera of the whole batch.

        Returns:
            `(B, H, W)` float32, metres along the optical axis at integer pixel centres; 0 is background.

        Raises:
            ValueError: A vertex is not finite or not in front of the camera.
        """
        ...


_BACKENDS = {
    "zbuffer": "ljn.render.zbuffer:ZBuffer",
    "pyrender": "ljn.render.opengl:PyRender",
    "open3d": "ljn.render.raycast:RayCaster",
}
RENDERERS = ("auto", *_BACKENDS)


def get_renderer(name: str = "auto") -> Renderer:
    """The renderer of that name, freshly built; `auto` is the fastest that needs no GL.

    Raises:
        ValueError: No such renderer.
        ImportError: The backend's package or its system libraries are missing.
    """
    if name not in RENDERERS:
        raise ValueError(f"renderer: expected one of {', '.join(RENDERERS)}, got '{name}'")
    module, _, attribute = _BACKENDS["zbuffer" if name == "auto" else name].partition(":")
    return getattr(import_module(module), attribute)()


def check_vertices(vertices: Tensor) -> None:
    """Raise a `ValueError` unless `vertices` `(B, V, 3)` are finite and in front of the camera."""
    if vertices.ndim != 3 or vertices.shape[-1] != 3:
        raise ValueError(f"vertices: expected (B, V, 3), got {tuple(vertices.shape)}")
    nearest = vertices[..., 2].amin() if vertices.numel() else vertices.new_tensor(1.0)
    if not bool(vertices.isfinite().all()):
        raise ValueError("vertices: NaN or infinite values; check the pose, the shape and the translation")
    if nearest <= 0:
        raise ValueError(
            f"vertices: the nearest has a depth of {float(nearest):.3f} m; the whole mesh must lie in front of "
            "the camera (camera frame: z forward, metres)"
        )
