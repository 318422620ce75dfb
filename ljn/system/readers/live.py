"""Cameras that record now, behind the interface of a recording."""

import logging
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from ljn.geometry.camera import Camera
from ljn.system.readers.alignment import Alignment
from ljn.system.readers.cameras import LensCamera
from ljn.system.readers.files import FileRecording
from ljn.system.recording import RgbdFrame

_log = logging.getLogger(__name__)
TIMEOUT_S = 5.0
"""A camera that gives no frame for so long has stopped."""
_USUAL_FPS = 30.0


class SensorStopped(RuntimeError):
    """A camera gives no more frames; the message says why."""


class RawFrame(NamedTuple):
    """A frame as a camera gives it."""

    depth: np.ndarray  # `(H, W)` float32, metres, 0 where nothing was measured
    rgb: np.ndarray | None  # `(h, w, 3)` uint8; None where this frame has none
    time_s: float | None  # by the camera's clock


class Sensor(Protocol):
    """A camera that runs."""

    name: str
    fps: float | None
    depth_camera: LensCamera
    rgb_camera: LensCamera | None  # None where colours are registered to the depth already
    facts: dict[str, object]
    is_file: bool  # which begins at its first frame, whoever asks

    def read(self) -> RawFrame:
        """The newest frame.

        Raises:
            SensorStopped: There will be no more.
            ValueError: This frame is damaged.
        """
        ...

    def close(self) -> None:
        """Stop it; more than once does nothing."""
        ...


class LiveRecording:
    """What a sensor records (see `ljn.system.recording.Recording`); its frames can be taken once.

    When the sensor stops, the frames end, and `facts["ended"]` says why.
    """

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self._align = Alignment(sensor.depth_camera, sensor.rgb_camera)
        self._facts: dict[str, object] = {"layout": "live", **sensor.facts, **self._align.facts}
        self._num_unreadable = 0
        self._is_over = False

    @property
    def name(self) -> str:
        """The sensor's name."""
        return self._sensor.name

    @property
    def camera(self) -> Camera:
        """See `Recording`."""
        return self._align.camera

    @property
    def num_frames(self) -> int | None:
        """See `Recording`."""
        return None

    @property
    def fps(self) -> float | None:
        """See `Recording`."""
        return self._sensor.fps

    @property
    def facts(self) -> dict[str, object]:
        """See `Recording`."""
        return {**self._facts, **({"unreadable": self._num_unreadable} if self._num_unreadable else {})}

    def close(self) -> None:
        """Stop the sensor; what takes its frames does so when it ends."""
        self._is_over = True
        self._sensor.close()

    def frames(self, start: int = 0) -> Iterator[RgbdFrame]:
        """The frames as they come, numbered from `start` on; of a file, those from number `start` on.

        Raises:
            RuntimeError: They were taken already.
        """
        if self._is_over:
            raise RuntimeError(f"the sensor {self.name} was closed; open it again with open_recording")
        self._is_over = True
        return self._frames(start)

    def _frames(self, start: int) -> Iterator[RgbdFrame]:
        first, latest = None, -np.inf
        try:
            for number in count(0 if self._sensor.is_file else start):
                name = f"frame_{number:06d}"
                try:
                    raw = self._sensor.read()
                except SensorStopped as stopped:
                    self._facts["ended"] = str(stopped)
                    _log.log(
                        logging.INFO if self._sensor.is_file else logging.WARNING,
                        "%s: %s",
                        self.name,
                        stopped,
                    )
                    return
                except ValueError as error:
                    self._num_unreadable += 1
                    frame = RgbdFrame(number, name, None, error=str(error))
                else:
                    time_s = raw.time_s
                    if time_s is not None and time_s > latest:
                        latest = time_s
                        first = time_s if first is None else first
                        time_s -= first
                    else:
                        time_s = None  # a clock that went back
                    if number < start:
                        continue
                    frame = RgbdFrame(number, name, *self._align(raw.depth, raw.rgb), time_s)
                if number >= start:
                    yield frame
        finally:
            self._sensor.close()


class Replay:
    """A recording in files given in real time (see `ljn.system.recording.Recording`).

    A frame comes when its time has come; one whose successor's time has come, too, is left out and counted.

    Args:
        recording: What is replayed.
        clock: Seconds, of any beginning.
        sleep: Waits so many seconds.
    """

    def __init__(
        self,
        recording: FileRecording,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._recording, self._clock, self._sleep = recording, clock, sleep
        self._num_late = 0
        self._is_over = False

    @property
    def name(self) -> str:
        """The recording's name."""
        return self._recording.name

    @property
    def camera(self) -> Camera:
        """See `Recording`."""
        return self._recording.camera

    @property
    def num_frames(self) -> int | None:
        """As of a sensor: None."""
        return None

    @property
    def fps(self) -> float | None:
        """See `Recording`."""
        return self._recording.fps

    @property
    def facts(self) -> dict[str, object]:
        """See `Recording`."""
        ended = {"ended": "the recording is over"} if self._is_over else {}
        return {**self._recording.facts, "replay": "in real time", "late_frames": self._num_late, **ended}

    def frames(self, start: int = 0) -> Iterator[RgbdFrame]:
        """See `Recording`; the clock begins with the first."""
        yield from self._recording.chosen_frames(self._due(start))
        self._is_over = True

    def _due(self, start: int) -> Iterator[int]:
        """The number of the frame that is due, whenever it is asked for."""
        times = self._times()
        begin = self._clock() - (times[start] if start < len(times) else 0)
        number = start
        while number < len(times):
            now = self._clock() - begin
            while number + 1 < len(times) and times[number + 1] <= now:
                number += 1
                self._num_late += 1
            if times[number] > now:
                self._sleep(times[number] - now)
            yield number
            number += 1

    def _times(self) -> list[float]:
        """Of each frame, seconds; equally spaced where some are not known."""
        known = [time for time in self._recording.times if time is not None]
        if len(known) == self._recording.num_frames:
            return known
        return [number / (self.fps or _USUAL_FPS) for number in range(self._recording.num_frames)]


def open_live(source: str, open_files: Callable[[Path], FileRecording]) -> LiveRecording | Replay:
    """What `live:SOURCE` names: `realsense`, `azure`, `kinect2`, or `replay:PATH`.

    Args:
        source: What stands behind `live:`.
        open_files: Opens the recording of a replay.

    Raises:
        ImportError: The sensor's driver is missing.
        RuntimeError: The sensor cannot be opened.
        ValueError: There is no such sensor.
    """
    if source.startswith("replay:"):
        return Replay(open_files(Path(source.removeprefix("replay:"))))
    if source == "realsense":
        from ljn.system.readers.realsense import RealSense

        return LiveRecording(RealSense())
    if source == "azure":
        from ljn.system.readers.azure import AzureKinect

        return LiveRecording(AzureKinect())
    if source == "kinect2":
        from ljn.system.readers.kinect2 import Kinect2

        return LiveRecording(Kinect2())
    raise ValueError(
        f"input: expected live:realsense, live:azure, live:kinect2 or live:replay:PATH, got {'live:' + source!r}"
    )
