"""A live view as a web page: the overlay, the cloud, the joints and the mesh, turned with the mouse."""

import time
from collections import deque
from types import TracebackType
from typing import Any, Self

import numpy as np

from ljn.body.skeleton import BONES
from ljn.geometry.camera import Camera
from ljn.optional import import_viser
from ljn.system.system import ArResult

_CLOUD, _MESH, _BONES = (150, 158, 168), (115, 158, 219), (214, 39, 40)
_BESIDE_M = 1.0  # the cloud, to the right of the mesh
_IMAGE_HZ = 10.0  # pictures in the panel; meshes come with every frame
_NUM_TIMES = 30  # frames of which the rate is taken


class WebView:
    """The page. It shows whatever came last to whoever looks; nobody has to.

    Args:
        camera: The recording's.
        port: Where the page is served; another one, where that is taken.
        host: Who may look: `127.0.0.1` for this machine alone, `0.0.0.0` for everybody.

    Raises:
        ImportError: viser is missing.
    """

    def __init__(self, camera: Camera, port: int = 8080, host: str = "127.0.0.1") -> None:
        viser = import_viser()
        self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.server.scene.set_up_direction("-y")  # the camera's y points down
        self.url = f"http://{host}:{self.server.get_port()}"
        self._placed = False
        self._times: deque[float] = deque(maxlen=_NUM_TIMES)
        self._last_image = 0.0
        empty = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._text = self.server.gui.add_markdown("waiting for the first frame")
        self._image = self.server.gui.add_image(empty, label="image", format="jpeg")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.server.stop()

    def show(self, result: ArResult, picture: np.ndarray) -> None:
        """Show a frame.

        Args:
            result: What became of it.
            picture: `(H, W, 3)` uint8, its overlay.
        """
        now = time.monotonic()
        self._times.append(now)
        rate = (len(self._times) - 1) / max(now - self._times[0], 1e-9)
        state = result.error or (f"sides {result.flip}" if result.flip else "found")
        self._text.content = f"**{result.frame.name}** {rate:.1f} frames/s  \n{state}"
        if now - self._last_image >= 1 / _IMAGE_HZ:
            self._image.image, self._last_image = picture, now
        if result.prediction is not None:
            with self.server.atomic():
                self._draw(result.prediction)

    def _draw(self, prediction: Any) -> None:
        scene, aside = self.server.scene, np.array([_BESIDE_M, 0, 0])
        points, joints = prediction.points[:, :3], prediction.joints
        if not self._placed:
            self._place(joints.mean(0))
        scene.add_point_cloud("/cloud", points + aside, _CLOUD, point_size=0.008, point_shape="circle")
        bones = joints[np.array(BONES)]
        scene.add_line_segments("/joints", bones + aside, _BONES, thickness=0.012)
        if prediction.vertices is not None:
            scene.add_mesh_simple("/mesh", prediction.vertices, prediction.faces, color=_MESH)

    def _place(self, middle: np.ndarray) -> None:
        """Let whoever comes look from where the camera is, at the person."""
        self.server.initial_camera.position = (0.5, -0.3, max(0.0, float(middle[2]) - 3.0))
        self.server.initial_camera.look_at = (float(middle[0]) + _BESIDE_M / 2, *map(float, middle[1:]))
        self._placed = True
