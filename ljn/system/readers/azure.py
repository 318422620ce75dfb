"""Azure Kinect cameras, through pyk4a."""

from typing import Any

import numpy as np

from ljn.geometry.camera import Camera
from ljn.optional import import_driver
from ljn.reading import reason
from ljn.system.readers.cameras import LensCamera
from ljn.system.readers.files import metres
from ljn.system.readers.live import TIMEOUT_S, RawFrame, SensorStopped


class AzureKinect:
    """An Azure Kinect (see `ljn.system.readers.live.Sensor`): depth of 640 x 576, colours of 1280 x 720 pixels.

    Raises:
        ImportError: pyk4a is missing.
        RuntimeError: There is no such camera, or it is in use.
    """

    name = "azure"
    fps: float | None = 30.0
    is_file = False

    def __init__(self) -> None:
        self._driver = k4a = import_driver(
            "pyk4a",
            "azure",
            "It is built against Microsoft's Azure Kinect Sensor SDK, which has to be there first",
        )
        settings = k4a.Config(
            color_resolution=k4a.ColorResolution.RES_720P,
            depth_mode=k4a.DepthMode.NFOV_UNBINNED,
            camera_fps=k4a.FPS.FPS_30,
            synchronized_images_only=True,
        )
        self._device = k4a.PyK4A(settings)
        self._is_open = False
        try:
            self._device.start()
            self._is_open = True
            # The calibration does not say the images' sizes.
            first = self._device.get_capture(int(1000 * TIMEOUT_S))
            self.depth_camera = self._camera(k4a.CalibrationType.DEPTH, first.depth, None)
            turn, shift = self._device.calibration.get_extrinsic_parameters(
                k4a.CalibrationType.DEPTH, k4a.CalibrationType.COLOR
            )
            motion = np.eye(4)
            motion[:3, :3], motion[:3, 3] = turn, np.ravel(shift)  # metres
            self.rgb_camera: LensCamera | None = self._camera(k4a.CalibrationType.COLOR, first.color, motion)
        except (k4a.K4AException, ValueError) as error:
            self.close()
            raise RuntimeError(
                f"input: no Azure Kinect can be opened ({reason(error)}): is it plugged in, powered, and not in "
                "use by another program?"
            ) from error
        self.facts: dict[str, object] = {"sensor": "Azure Kinect"}

    def _camera(self, kind: Any, image: np.ndarray | None, motion: np.ndarray | None) -> LensCamera:
        if image is None:
            raise ValueError("its first frame is incomplete")
        matrix = self._device.calibration.get_camera_matrix(kind)
        height, width = image.shape[:2]
        fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        camera = Camera(fx, fy, cx, cy, width, height)
        lens = tuple(float(number) for number in self._device.calibration.get_distortion_coefficients(kind))
        return LensCamera(camera, lens, None if motion is None else tuple(map(tuple, motion.tolist())))

    def read(self) -> RawFrame:
        """See `Sensor`."""
        try:
            capture = self._device.get_capture(int(1000 * TIMEOUT_S))
        except self._driver.K4ATimeoutException:
            raise SensorStopped(f"no frame for {TIMEOUT_S:g} s: was it unplugged?") from None
        except self._driver.K4AException as error:
            raise SensorStopped(f"the sensor failed ({reason(error)}): was it unplugged?") from error
        depth, bgra = capture.depth, capture.color
        if depth is None or bgra is None:
            raise ValueError(f"the sensor gave a frame without {'colours' if bgra is None else 'depth'}")
        # Millimetres.
        return RawFrame(
            metres(depth), np.ascontiguousarray(bgra[..., 2::-1]), capture.depth_timestamp_usec / 1e6
        )

    def close(self) -> None:
        """See `Sensor`."""
        if self._is_open:
            self._is_open = False
            self._device.stop()
