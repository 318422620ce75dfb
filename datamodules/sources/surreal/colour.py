"""SURREAL's own colour frames: turned back from its mirror, with its masks."""

from collections.abc import Sequence

import numpy as np

from datamodules.scenes import Frame, Scene
from datamodules.sources import PoseRecords
from datamodules.sources.surreal.files import VIDEO
from datamodules.sources.surreal.filmed import FilmedSource
from datamodules.sources.surreal.video import read_video


class SurrealRgbSource(FilmedSource[Frame]):
    """SURREAL's frames in colour, of `SEQUENCE_c0001.mp4`, in place of rendered pictures; see `FilmedSource`."""

    name = "surreal_rgb"
    images = VIDEO
    kind = "colour"

    def _images(self, name: str, frames: Sequence[int], length: int) -> list[Frame]:
        pictures = read_video(self.tree / f"{name}{self.images}", frames, length)
        return [
            Frame(np.ascontiguousarray(rgb[:, ::-1]), mask)
            for rgb, mask in zip(pictures, self._masks(name, frames))
        ]

    def _num_pixels(self, image: Frame) -> int:
        return int(image.mask.sum())

    def filmed(self, records: PoseRecords, rows: Sequence[int]) -> tuple[Scene, list[Frame]]:
        """The bodies of some records before the camera, and what it saw; see `FrameSource`."""
        return self._filmed(records, rows, with_images=True)
