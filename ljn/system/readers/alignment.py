"""Depth and colour images as cameras take them, made straight and laid upon each other."""

import math

import numpy as np

from ljn.geometry.camera import Camera
from ljn.system.readers.cameras import LensCamera
from ljn.system.readers.kernels import CELLS_PER_PIXEL, find_places, take_colours, write_distorted


class Alignment:
    """Undoes the distortion of depth images and colours them; what depends on the cameras alone is computed once.

    Args:
        depth_camera: The depth camera.
        rgb_camera: The colour camera; None where colour images are registered to the depth images already.
    """

    def __init__(self, depth_camera: LensCamera, rgb_camera: LensCamera | None = None) -> None:
        self.depth_camera, self.rgb_camera = depth_camera, rgb_camera
        size = (depth_camera.camera.height, depth_camera.camera.width)
        self._straight = None  # `(2, H, W)`: of each pixel, u and v in the distorted image
        if depth_camera.lens.size:
            self._straight = np.empty((2, *size), np.float32)
            write_distorted(depth_camera.intrinsics, depth_camera.lens, self._straight)
        if rgb_camera is not None:
            self._scale = CELLS_PER_PIXEL * depth_camera.camera.fx / rgb_camera.camera.fx
            self._places = np.empty((*size, 3), np.float32)
            cells = (math.ceil(side * self._scale) for side in self.rgb_size)
            self._nearest = np.empty(tuple(cells), np.float32)

    @property
    def camera(self) -> Camera:
        """That of the aligned images."""
        return self.depth_camera.camera

    @property
    def rgb_size(self) -> tuple[int, int]:
        """Height and width of the colour images that are taken, pixels."""
        camera = (self.rgb_camera or self.depth_camera).camera
        return camera.height, camera.width

    @property
    def facts(self) -> dict[str, object]:
        """What is done, for a summary."""
        facts: dict[str, object] = {}
        cameras = {"depth": self.depth_camera, "colour": self.rgb_camera or self.depth_camera}
        if distorted := [name for name, camera in cameras.items() if camera.lens.size]:
            facts["undistorted"] = " and ".join(distorted)
        if self.rgb_camera is not None:
            is_known = self.rgb_camera.rgb_from_depth is not None
            facts["registration"] = (
                f"by the cameras, {'extrinsics given' if is_known else 'in the same place'}"
            )
        return facts

    def __call__(self, depth: np.ndarray, rgb: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
        """The straight depth image, and its pixels' colours, black where none is known.

        Args:
            depth: `(H, W)` float32, metres, 0 where nothing was measured, as the depth camera gives it.
            rgb: `(h, w, 3)` uint8 as the colour camera gives it; None for none.

        Returns:
            `(H, W)` float32, metres, and `(H, W, 3)` uint8, or None.
        """
        if self._straight is not None:
            depth = _moved(depth, self._straight, is_smooth=False)
        if rgb is None:
            return depth, None
        if self.rgb_camera is None:
            return depth, rgb if self._straight is None else _moved(rgb, self._straight, is_smooth=True)
        colours = np.empty((*depth.shape, 3), np.uint8)
        places, nearest, scale = self._places, self._nearest, self._scale
        find_places(
            np.ascontiguousarray(depth, np.float32),
            self.depth_camera.intrinsics,
            self.rgb_camera.motion,
            self.rgb_camera.intrinsics,
            self.rgb_camera.lens,
            self.rgb_size,
            scale,
            places,
            nearest,
        )
        take_colours(np.require(rgb, requirements=["C", "W"]), places, nearest, scale, colours)
        return depth, colours


def _moved(image: np.ndarray, places: np.ndarray, is_smooth: bool) -> np.ndarray:
    """The image's values at `places` `(2, H, W)`: those of the nearest pixels, or bilinear; 0 outside."""
    import cv2

    u, v = places
    # Depths are never mixed: between a body and the wall behind it there is nothing.
    if not is_smooth:
        return cv2.remap(image, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    found = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    height, width = image.shape[:2]
    found[(u < -0.5) | (v < -0.5) | (u >= width - 0.5) | (v >= height - 0.5)] = 0
    return found
