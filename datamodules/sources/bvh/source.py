"""BVH folders as a source of poses."""

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from datamodules.sources.bvh.file import BvhFile, read_bvh
from datamodules.sources.bvh.retargeting import retarget
from datamodules.sources.bvh.skeleton import AUTO, Skeleton, fitting, known_skeletons
from datamodules.sources.recorded import RecordedSource
from datamodules.sources.recordings import Motion
from ljn.geometry.rotations import rotmat_to_rotvec, smpl_pose_to_body_world


class BvhSource(RecordedSource):
    """Poses of a folder of BVH files, brought to SMPL's joints; settings are those of `RecordedSource`.

    A subject is the folder that a file is in, or, of a file right in `path`, its name up to a `_`: CMU's `01_02.bvh` is
    of subject 01.

    Args:
        skeleton: Which joint is which: `auto`, a name of `skeleton.SHIPPED`, or a YAML file; see `Skeleton`.
        settings: See `RecordedSource`.
    """

    name = "bvh"
    suffix = ".bvh"
    other_axes = "in a table of the skeleton, rest_frame says in which frame a person stands"
    licence = "BVH files that the user brought; their licence is not known here"

    def __init__(self, path: str | Path | None = None, skeleton: str | Path = AUTO, **settings: Any) -> None:
        super().__init__(path, **settings)
        self.skeleton = skeleton

    @cached_property
    def _skeletons(self) -> list[Skeleton]:
        return known_skeletons(self.skeleton)

    @property
    def reader_settings(self) -> str:
        """See `RecordedSource.reader_settings`."""
        return f"{super().reader_settings} {self._skeletons}"

    def read(self, path: Path) -> list[Motion]:
        """See `RecordedSource.read`."""
        bvh = read_bvh(path)
        candidates = fitting(self._skeletons, bvh.names)
        errors: list[ValueError] = []
        for skeleton, places in candidates:
            try:
                return [self._motion(bvh, skeleton, places)]
            except ValueError as error:  # the same names, but another rest pose
                errors.append(error)
        raise errors[0]

    def _motion(self, bvh: BvhFile, skeleton: Skeleton, places: dict[str, int]) -> Motion:
        frame = self.steps(len(bvh.frames), bvh.rate_hz, skeleton.skip_frames)
        if not len(frame):
            raise ValueError(
                f"MOTION: {len(bvh.frames)} frames, of which {skeleton.name} leaves out {skeleton.skip_frames}"
            )
        rotmat = retarget(bvh, skeleton, places, frame)
        pose = smpl_pose_to_body_world(rotmat_to_rotvec(rotmat).flatten(1)).numpy()
        notes = bvh.notes
        if missing := skeleton.missing(bvh.names):
            notes = (*notes, f"joints: no {', '.join(missing)} of {skeleton.name}; these follow the others")
        return Motion(pose, np.asarray(frame), notes=notes)
