"""A video's frames, one after another."""

from pathlib import Path
from types import TracebackType

import numpy as np

VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv")


class Video:
    """A video, read forwards; one frame is in memory at a time.

    Args:
        path: Its file.

    Attributes:
        fps: Frames a second as its file says; None where it does not.
        num_frames: How many frames its file says there are: an estimate.

    Raises:
        ValueError: It cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        import cv2

        self._path = path
        # Of FFmpeg alone: others take a number in the name for that of the first of many pictures.
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            self._capture.release()
            raise ValueError(
                f"rgb: the video '{path}' is damaged, cut off or of another format; write it again"
            )
        self._next = 0
        fps = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps: float | None = float(fps) if 0 < fps < 1000 else None
        self.num_frames = max(0, int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)))

    def __enter__(self) -> "Video":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._capture.release()

    def read(self, number: int) -> np.ndarray:
        """Frame `number`, from 0; `(H, W, 3)` uint8, red, green, blue. Those before it are passed over.

        Raises:
            ValueError: The video ends before it, it was passed already, or it is damaged.
        """
        import cv2

        if number < self._next:
            raise ValueError(
                f"rgb: frame {number} of '{self._path}' was passed already; open the video again"
            )
        while self._next <= number:
            if not self._capture.grab():
                raise ValueError(
                    f"rgb: the video '{self._path}' ends at frame {self._next}, before frame {number}"
                )
            self._next += 1
        is_read, image = self._capture.retrieve()
        if not is_read or image is None or image.ndim != 3:
            raise ValueError(f"rgb: frame {number} of the video '{self._path}' is damaged")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
