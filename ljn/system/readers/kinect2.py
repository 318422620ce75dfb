"""Kinect v2 cameras, through freenect2."""

import time
from threading import Condition
from typing import Any

import numpy as np

from ljn.geometry.camera import Camera
from ljn.optional import import_driver
from ljn.reading import reason
from ljn.system.readers.cameras import LensCamera
from ljn.system.readers.files import metres
from ljn.system.readers.live import TIMEOUT_S, RawFrame, SensorStopped

_SIZE = (512, 424)


class _Newest:
    """Keeps the newest depth and colour frame that the driver's thread gives."""

    def __init__(self) -> None:
        self._ready = Condition()
        self._frames: dict[str, Any] = {}
        self._time_s = 0.0

    def __call__(self, kind: Any, frame: Any) -> None:
        with self._ready:
            self._frames[kind.name] = frame
            if kind.name == "Depth":
                self._time_s = time.monotonic()  # the unit of the frame's own time is not said
            self._ready.notify()

    def take(self, timeout_s: float) -> tuple[Any, Any, float] | None:
        """Colour and depth, each once, and the depth's time, seconds; None where they do not come."""
        with self._ready:
            if not self._ready.wait_for(lambda: {"Color", "Depth"} <= self._frames.keys(), timeout_s):
                return None
            return self._frames.pop("Color"), self._frames.pop("Depth"), self._time_s


class Kinect2:
    """A Kinect v2 (see `ljn.system.readers.live.Sensor`).

    The driver itself undoes the distortion and registers the colours, by the sensor's own calibration, which has no
    extrinsics.

    Raises:
        ImportError: freenect2 is missing.
        RuntimeError: There is no such camera, or it is in use.
    """

    name = "kinect2"
    fps: float | None = 30.0
    is_file = False
    rgb_camera: LensCamera | None = None

    def __init__(self) -> None:
        driver = import_driver(
            "freenect2", "kinect2", "It is built against libfreenect2, which has to be there first"
        )
        try:
            self._device = driver.Device()
        except driver.NoDeviceError as error:
            raise RuntimeError(
                f"input: no Kinect v2 can be opened ({reason(error)}): is it plugged in, powered, and no other program "
                "using it?"
            ) from error
        self._is_open = True
        self._newest = _Newest()
        self._device.start(self._newest)
        lens = self._device.ir_camera_params
        width, height = _SIZE
        # Its images are mirrored: columns are counted from the other side.
        self.depth_camera = LensCamera(
            Camera(float(lens.fx), float(lens.fy), width - 1 - float(lens.cx), float(lens.cy), width, height)
        )
        self.facts: dict[str, object] = {
            "sensor": "Kinect v2",
            "registration": "by the driver",
            "undistorted": "by the driver",
        }

    def read(self) -> RawFrame:
        """See `Sensor`."""
        frames = self._newest.take(TIMEOUT_S)
        if frames is None:
            raise SensorStopped(f"no frame for {TIMEOUT_S:g} s: was it unplugged?")
        rgb, depth, time_s = frames
        straight, registered = self._device.registration.apply(rgb, depth)
        found = metres(straight.to_array()[:, ::-1] / np.float32(1000))
        colours = registered.to_array()[:, ::-1]
        is_bgr = rgb.format.name == "BGRX"
        colours = np.ascontiguousarray(colours[..., 2::-1] if is_bgr else colours[..., :3])
        return RawFrame(found, colours, time_s)

    def close(self) -> None:
        """See `Sensor`."""
        if self._is_open:
            self._is_open = False
            self._device.stop()
            self._device.close()
