"""Intel's RealSense cameras, live or from the `.bag` or `.db3` files that they record, through pyrealsense2."""

import math
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from ljn.geometry.camera import Camera
from ljn.optional import import_driver
from ljn.reading import reason
from ljn.system.readers.cameras import LensCamera
from ljn.system.readers.files import metres
from ljn.system.readers.live import TIMEOUT_S, RawFrame, SensorStopped

_SIZE, _FPS = (640, 480), 30  # what all of them can do
# Since librealsense 2.50 all three project by OpenCV's formula; the D400's depth images have no distortion.
_BROWN_CONRADY = ("brown_conrady", "modified_brown_conrady", "inverse_brown_conrady")


class RealSense:
    """A RealSense camera (see `ljn.system.readers.live.Sensor`).

    Args:
        bag: A file that one has recorded; None for the camera that is plugged in.

    Raises:
        ImportError: pyrealsense2 is missing.
        RuntimeError: There is no such camera, or it is in use.
        ValueError: It is of a kind that is not known, or the file is none of its own.
    """

    def __init__(self, bag: Path | None = None) -> None:
        rs = import_driver("pyrealsense2", "realsense")
        self._pipeline, config = rs.pipeline(), rs.config()
        if bag is None:
            config.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, _FPS)
            config.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, _FPS)
        else:
            config.enable_device_from_file(str(bag), repeat_playback=False)
            config.enable_stream(rs.stream.depth, rs.format.z16, 0)
            config.enable_stream(rs.stream.color, rs.format.rgb8, 0)
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            what = "no RealSense camera can be opened" if bag is None else f"'{bag}' cannot be played"
            fix = "is it plugged in, and no other program using it" if bag is None else "is it whole"
            raise RuntimeError(f"input: {what} ({reason(error)}): {fix}?") from error
        self._is_open = True
        try:
            device = profile.get_device()
            if bag is not None:
                playback = device.as_playback()
                playback.set_real_time(False)  # all frames, however slowly they are taken
                playback.seek(timedelta(0))  # some may have passed by since it was started
            depth = profile.get_stream(rs.stream.depth).as_video_stream_profile()
            rgb = profile.get_stream(rs.stream.color).as_video_stream_profile()
            self._scale = 1 / float(device.first_depth_sensor().get_depth_scale())
            self.depth_camera = _camera(depth.get_intrinsics())
            found = _camera(rgb.get_intrinsics())
            self.rgb_camera: LensCamera | None = LensCamera(
                found.camera, found.distortion, _motion(depth.get_extrinsics_to(rgb))
            )
            self.fps: float | None = float(depth.fps())
            model = str(device.get_info(rs.camera_info.name))
        except (RuntimeError, ValueError):
            self.close()
            raise
        self.is_file = bag is not None
        self._is_over = False
        self._latest: int | None = None  # depth image, by the driver's number
        self._following: Any = None  # of a file, the set after the one that was given
        self.name = "realsense" if bag is None else bag.stem
        self.facts: dict[str, object] = {
            **({"layout": f"RealSense {bag.suffix}"} if bag else {}),
            "sensor": model,
        }

    def read(self) -> RawFrame:
        """See `Sensor`; of sets with one depth image, that with the colours nearest in time, or, live, the first."""
        chosen, self._following = self._following or self._wait(), None
        while (number := _depth_number(chosen)) is not None and number == self._latest:
            chosen = self._wait()
        self._latest = number
        if self.is_file and not self._is_over:
            try:
                while _depth_number(following := self._wait()) == number:
                    chosen = min(chosen, following, key=_apart_ms)
                self._following = following
            except SensorStopped:
                pass  # after this frame
        depth, rgb = chosen.get_depth_frame(), chosen.get_color_frame()
        if not depth or not rgb:
            raise ValueError(f"the sensor gave a frame without {'colours' if depth else 'depth'}")
        return RawFrame(
            metres(np.asanyarray(depth.get_data()), self._scale),
            np.array(rgb.get_data(), np.uint8),  # a copy: the driver uses its memory again
            depth.get_timestamp() / 1000,
        )

    def _wait(self) -> Any:
        """The next set of images; raises `SensorStopped` where none comes."""
        why = "the file is over" if self.is_file else f"no frame for {TIMEOUT_S:g} s: was it unplugged?"
        if self._is_over:
            raise SensorStopped(why)
        try:
            is_there, frames = self._pipeline.try_wait_for_frames(int(1000 * TIMEOUT_S))
        except RuntimeError as error:
            is_there, why = False, f"the sensor failed ({reason(error)}): was it unplugged?"
        if not is_there:
            self._is_over = True
            raise SensorStopped(why)
        return frames

    def close(self) -> None:
        """See `Sensor`."""
        if self._is_open:
            self._is_open = False
            self._pipeline.stop()


def _depth_number(frames: Any) -> int | None:
    """The driver's number of a set's depth image; None where there is none."""
    depth = frames.get_depth_frame()
    return depth.get_frame_number() if depth else None


def _apart_ms(frames: Any) -> float:
    """Between a set's depth image and its colours."""
    depth, rgb = frames.get_depth_frame(), frames.get_color_frame()
    return abs(depth.get_timestamp() - rgb.get_timestamp()) if depth and rgb else math.inf


def _camera(intrinsics: Any) -> LensCamera:
    coefficients = tuple(float(number) for number in intrinsics.coeffs)
    model = str(intrinsics.model).rpartition(".")[2]
    if any(coefficients) and model not in _BROWN_CONRADY:
        raise ValueError(f"distortion: expected one of {', '.join(_BROWN_CONRADY)}, the sensor has {model}")
    size = int(intrinsics.width), int(intrinsics.height)
    return LensCamera(
        Camera(intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy, *size),
        coefficients if any(coefficients) else (),
    )


def _motion(extrinsics: Any) -> tuple[tuple[float, ...], ...]:
    """`rgb_from_depth`, metres; the driver gives the rotation column by column."""
    motion = np.eye(4)
    motion[:3, :3] = np.reshape(extrinsics.rotation, (3, 3)).T
    motion[:3, 3] = extrinsics.translation
    return tuple(map(tuple, motion.tolist()))
