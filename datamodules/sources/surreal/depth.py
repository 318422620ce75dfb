"""SURREAL's own depth images, as scenes: turned back from its mirror, cut out by its masks, of planar depth."""

import logging
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from datamodules.scenes import Scene
from datamodules.sources import PoseRecords
from datamodules.sources.surreal.bodies import lengthening, radial_share
from datamodules.sources.surreal.files import BACKGROUND_M, DEPTH, read_images
from datamodules.sources.surreal.filmed import FilmedSource

_LOG = logging.getLogger(__name__)
_DOUBT = (0.3, 0.7)


class SurrealDepthSource(FilmedSource[np.ndarray]):
    """SURREAL's frames with the depth images that come with them; see `FilmedSource`.

    What the mask leaves of an image is the body. Nothing is added to the images: no noise, no sensor. Meshes are
    compared with the bodies of the records' shapes.

    Args:
        radial: Whether the depth is the length of the ray to a point (`true`), or its distance along the optical axis
            (`false`); `auto` measures which of the two the bodies in the frames agree with.
        others: As `FilmedSource`.
    """

    name = "surreal_depth"
    images = DEPTH

    def __init__(self, *args: Any, radial: bool | str = "auto", **others: Any) -> None:
        super().__init__(*args, **others)
        if radial not in (True, False, "auto"):
            raise ValueError(f"radial: expected true, false or auto, got {radial!r}")
        self.radial = radial

    @property
    def kind(self) -> str:
        """See `FilmedSource.kind`: whether depth is radial."""
        return str(self.is_radial)

    @cached_property
    def is_radial(self) -> bool:
        """Whether the images hold the lengths of rays."""
        if self.radial != "auto":
            return bool(self.radial)
        rendered = [self._bodies.rendered(clip, np.array([frame]))[0] for clip, frame, _ in self._sample]
        share = radial_share([image for *_, image in self._sample], rendered)
        if not (share <= _DOUBT[0] or share >= _DOUBT[1]):
            raise ValueError(
                f"data.source.radial: cannot be measured on {len(rendered)} frames: {share:.2f} of a ray's greater "
                "length is in the depth, expected about 0 (planar) or 1 (radial); set data.source.radial=true or false"
            )
        _LOG.info("SURREAL: depth is %s (measured: %.2f)", "radial" if share > 0.5 else "planar", share)
        return share > 0.5

    def _images(self, name: str, frames: Sequence[int], length: int) -> list[np.ndarray]:
        """See `FilmedSource`: `(240, 320)` float32, metres, as stored; 0 where the body is not."""
        depths = read_images(self.tree / f"{name}{self.images}", "depth", frames)
        # Of NaN, no comparison holds.
        return [
            np.where(mask & (depth > 0) & (depth < BACKGROUND_M), depth, 0).astype(np.float32)
            for depth, mask in zip((depth[:, ::-1] for depth in depths), self._masks(name, frames))
        ]

    def _num_pixels(self, image: np.ndarray) -> int:
        return int(np.count_nonzero(image))

    def scene(self, records: PoseRecords, rows: Sequence[int], with_depth: bool) -> Scene:
        """The bodies of some records before the camera; see `ImageSource`."""
        scene, images = self._filmed(records, rows, with_depth)
        if not with_depth:
            return scene._replace(depth=[np.zeros((0, 0), np.float32)] * len(rows))
        factor = lengthening() if self.is_radial else 1
        return scene._replace(depth=[(image / factor).astype(np.float32) for image in images])
