"""What a recording or a live sensor gives: frames of depth and colour, registered to each other."""

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np

from ljn.geometry.camera import Camera


class RgbdFrame(NamedTuple):
    """A frame.

    Attributes:
        number: Its place in the recording, from 0; of a frame that could not be read, too.
        name: Names its outputs.
        depth: `(H, W)` float32, metres, 0 where nothing was measured; None where it could not be read.
        rgb: `(H, W, 3)` uint8, red, green, blue, registered to the depth image pixel by pixel, black where no colour is
            known; None without colours.
        timestamp_s: Seconds since the first frame; None where nobody knows.
        error: Why it could not be read; None otherwise.
    """

    number: int
    name: str
    depth: np.ndarray | None
    rgb: np.ndarray | None = None
    timestamp_s: float | None = None
    error: str | None = None


class Recording(Protocol):
    """A recording, or a sensor that is recording now."""

    @property
    def name(self) -> str:
        """Names it."""
        ...

    @property
    def camera(self) -> Camera:
        """The depth camera, and after registration that of the colours, too; without distortion."""
        ...

    @property
    def num_frames(self) -> int | None:
        """How many frames there are; None of a live sensor."""
        ...

    @property
    def fps(self) -> float | None:
        """Frames a second as recorded; None where nobody knows."""
        ...

    @property
    def facts(self) -> dict[str, object]:
        """What was found in the files and done about them (layout, registration, frames left out): for the summary."""
        ...

    def frames(self, start: int = 0) -> Iterator[RgbdFrame]:
        """The frames from number `start` on, in order, each read when it is needed."""
        ...
