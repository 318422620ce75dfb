"""SURREAL's own depth images, as scenes: turned back from its mirror, cut out by its masks, of planar depth."""

import hashlib
import logging
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from datamodules.scenes import Scene
from datamodules.sources import PoseRecords
from datamodules.sources.surreal.bodies import ClipBodies, lengthening, radial_share
from datamodules.sources.surreal.files import (
    BACKGROUND_M,
    DEPTH,
    INFO,
    SEGMENTATION,
    FilmedClip,
    read_filmed_clip,
    read_images,
)
from datamodules.sources.surreal.index import ClipEntry
from datamodules.sources.surreal.source import SurrealSource
from datamodules.sources.surreal.world import CAMERA, to_camera, turned_pose
from ljn.body import load_body_models

_LOG = logging.getLogger(__name__)
_NUM_MEASURED = 40  # clips, of each a frame, that say what kind of depth and whose bodies the tree has
_SAME_BODY_M = 0.005
_DOUBT = (0.3, 0.7)
_LEAST_PIXELS = 50
_FRAMES_OF_SHAPE = 10


class SurrealDepthSource(SurrealSource):
    """SURREAL's frames with the depth images that come with them: in place of rendered ones.

    An image is turned back from SURREAL's mirror; what its mask (`_segm.mat`) leaves is the body. Poses are the file's,
    turned by `zrot`; joints are its `joints3D`. Nothing is added to the images: no noise, no sensor.

    Where the loaded bodies are those that SURREAL was made with (their joints are the file's within 5 mm), shapes are
    the file's, too; else those with which the bodies' joints come nearest, and meshes are compared with these: an
    approximation. A frame whose image is damaged, or shows less than 50 pixels of a body, is left out.

    Args:
        radial: Whether the depth is the length of the ray to a point (`true`), or its distance along the optical axis
            (`false`); `auto` measures which of the two the bodies in the frames agree with.
        body_path: The bodies; see `load_body_models`.
        others: As `SurrealSource`.
    """

    name = "surreal_depth"
    camera = CAMERA

    def __init__(
        self, *args: Any, radial: bool | str = "auto", body_path: str | Path | None = None, **others: Any
    ) -> None:
        super().__init__(*args, **others)
        if radial not in (True, False, "auto"):
            raise ValueError(f"radial: expected true, false or auto, got {radial!r}")
        self.radial = radial
        self.body_path = body_path

    @property
    def fingerprint(self) -> str:
        """See `PoseSource.fingerprint`: also of the bodies, and of the kind of depth."""
        bodies = sorted(body.hash for body in self._models)
        made_of = f"{super().fingerprint} {bodies} {self.is_radial}"
        return hashlib.sha256(made_of.encode()).hexdigest()[:16]

    def check(self) -> None:
        """Read the index, or make it, and measure the kind of depth where that is wanted."""
        super().check()
        _ = self.is_radial, self.is_of_bodies

    @cached_property
    def _models(self) -> Any:
        return load_body_models(self.body_path, self.genders)

    @cached_property
    def _bodies(self) -> ClipBodies:
        return ClipBodies(self._models)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_bodies", "_sample")}

    def _is_usable(self, entry: ClipEntry) -> bool:
        return super()._is_usable(entry) and all(
            (self.tree / f"{entry.name}{kind}").is_file() for kind in (DEPTH, SEGMENTATION)
        )

    @cached_property
    def _sample(self) -> list[tuple[FilmedClip, int, np.ndarray]]:
        """Clips from all over the tree, of each a frame and its masked depth as it stands in the file, turned back."""
        entries = self._parts["test"] or self._parts["train"]
        sample = []
        for i in np.unique(np.linspace(0, len(entries) - 1, _NUM_MEASURED).astype(int)):
            clip, seen = self._seen(
                entries[i], entries[i].good_frames[len(entries[i].good_frames) // 2 :][:1]
            )
            sample += [(clip, frame, image) for frame, image in seen if clip is not None]
        if not sample:
            raise ValueError(
                f"data.source.path: no depth image in {self.tree} can be read, of {len(entries)} clips"
            )
        return sample

    @cached_property
    def is_of_bodies(self) -> bool:
        """Whether the loaded bodies are those that SURREAL was made with."""
        errors = [self._bodies.errors_m(clip, np.array([frame])).mean() for clip, frame, _ in self._sample]
        if (error := float(np.median(errors))) < _SAME_BODY_M:
            return True
        _LOG.warning(
            "SURREAL: the joints of the loaded bodies lie %.0f mm from those of its files: other bodies. Shapes are "
            "fitted to its joints, and errors of meshes are against these, an approximation; the official SMPL bodies "
            "(body=smpl body.path=FOLDER) are its own",
            1000 * error,
        )
        return False

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

    def _seen(
        self, entry: ClipEntry, frames: np.ndarray
    ) -> tuple[FilmedClip | None, list[tuple[int, np.ndarray]]]:
        """A clip, and those of its frames that are whole, each with its image; None where the clip is damaged."""
        try:
            clip = read_filmed_clip(self.tree / f"{entry.name}{INFO}")
            images = self._images(entry.name, frames.tolist())
        except (ValueError, OSError) as error:
            _LOG.warning("left out: %s", error)
            return None, []
        return clip, [
            (int(frame), image)
            for frame, image in zip(frames, images)
            if frame < len(clip) and clip.is_good[frame] and np.count_nonzero(image) >= _LEAST_PIXELS
        ]

    def _images(self, name: str, frames: Sequence[int]) -> list[np.ndarray]:
        """Depth `(240, 320)` float32, metres, of the body in frames of a clip, as stored but turned back; else 0."""
        depths, parts = (
            read_images(self.tree / f"{name}{kind}", key, frames)
            for kind, key in ((DEPTH, "depth"), (SEGMENTATION, "segm"))
        )
        # Of NaN, no comparison holds.
        return [
            np.where((part > 0) & (depth > 0) & (depth < BACKGROUND_M), depth, 0)[:, ::-1].astype(np.float32)
            for depth, part in zip(depths, parts)
        ]

    def _columns(self, entry: ClipEntry, frames: np.ndarray) -> tuple[np.ndarray, ...]:
        clip, seen = self._seen(entry, frames)
        whole = np.array([frame for frame, _ in seen], np.int64)
        if clip is None or not len(whole):
            empty = np.zeros(0, np.int64)
            return (
                np.zeros((0, 72), np.float32),
                np.zeros((0, 10), np.float32),
                empty,
                np.zeros(0, str),
                empty,
            )
        betas = clip.betas[whole]
        if not self.is_of_bodies:
            of_shape = np.flatnonzero(clip.is_good)
            of_shape = of_shape[:: -(-len(of_shape) // _FRAMES_OF_SHAPE)]
            betas = np.tile(self._bodies.fitted_betas(clip, of_shape), (len(whole), 1)).astype(np.float32)
        pose = turned_pose(clip.pose[whole], clip.zrot[whole]).astype(np.float32)
        return pose, betas, clip.gender[whole], np.full(len(whole), entry.name), whole

    def scene(self, records: PoseRecords, rows: Sequence[int], with_depth: bool) -> Scene:
        """The bodies of some records before the camera; see `ImageSource`."""
        joints, depth = [], []
        for row in rows:
            name, frame = str(records.sequence[row]), int(records.frame[row])
            clip = read_filmed_clip(self.tree / f"{name}{INFO}")
            joints.append(to_camera(clip.joints[frame], clip.camera_place))
            if not with_depth:
                depth.append(np.zeros((0, 0), np.float32))
                continue
            [image] = self._images(name, [frame])
            depth.append((image / lengthening() if self.is_radial else image).astype(np.float32))
        columns = (
            torch.from_numpy(values[list(rows)]) for values in (records.pose, records.betas, records.gender)
        )
        pose, betas, gender = columns
        return Scene(pose, betas, gender, torch.from_numpy(np.stack(joints)), [CAMERA] * len(rows), depth)
