"""SURREAL's frames with the images that it made of them: what its depth and its colour have in common."""

import hashlib
import logging
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch

from datamodules.scenes import Scene
from datamodules.sources import SPLITS, PoseRecords
from datamodules.sources.surreal.bodies import ClipBodies
from datamodules.sources.surreal.check import from_all_over
from datamodules.sources.surreal.files import INFO, SEGMENTATION, FilmedClip, read_filmed_clip, read_images
from datamodules.sources.surreal.index import ClipEntry
from datamodules.sources.surreal.source import SurrealSource
from datamodules.sources.surreal.world import CAMERA, to_camera, turned_pose
from ljn.body import BodyModel, load_body_models
from ljn.data import Finding

_LOG = logging.getLogger(__name__)
_NUM_MEASURED = 40  # clips, of each a frame, that say what kind of images and whose bodies the tree has
_SAME_BODY_M = 0.005
_LEAST_PIXELS = 50
_FRAMES_OF_SHAPE = 10

Image = TypeVar("Image")


class FilmedSource(SurrealSource, Generic[Image]):
    """SURREAL's frames with images that come with them, in place of rendered ones.

    An image is turned back from SURREAL's mirror; the mask (`_segm.mat`) says what of it is the body. Poses are the
    file's, turned by `zrot`; joints are its `joints3D`.

    Where the loaded bodies are those that SURREAL was made with (their joints are the file's within 5 mm), shapes are
    the file's, too; else those with which the bodies' joints come nearest: an approximation. A frame whose image is
    damaged, or shows less than 50 pixels of a body, is left out.

    Args:
        body_path: The bodies; see `load_body_models`.
        others: As `SurrealSource`.
    """

    images: ClassVar[str]
    """The end of the name of the file that holds a clip's images."""
    camera = CAMERA

    def __init__(self, *args: Any, body_path: str | Path | None = None, **others: Any) -> None:
        super().__init__(*args, **others)
        self.body_path = body_path
        self.files = (*self.files, self.images, SEGMENTATION)

    @property
    @abstractmethod
    def kind(self) -> str:
        """Which of several readings the images have."""

    @abstractmethod
    def _images(self, name: str, frames: Sequence[int], length: int) -> list[Image]:
        """The images of some frames of a clip of so many, turned back.

        Raises:
            OSError: A file is missing.
            ValueError: One is damaged.
        """

    @abstractmethod
    def _num_pixels(self, image: Image) -> int:
        """How many pixels show the body."""

    @property
    def fingerprint(self) -> str:
        """See `PoseSource.fingerprint`: also of the bodies, and of the kind and the sizes of images."""
        bodies = sorted(body.hash for body in self._models)
        # A file that was cut off and is copied again has another size.
        sizes = [self._sizes[entry.name] for split in SPLITS for entry in self._parts[split]]
        made_of = f"{super().fingerprint} {bodies} {self.kind} {sizes}"
        return hashlib.sha256(made_of.encode()).hexdigest()[:16]

    def check(self) -> None:
        """Read the index, or make it, and find out what kind of images and whose bodies there are."""
        super().check()
        _ = self.kind, self.is_of_bodies

    def examine(self, bodies: Sequence[BodyModel], num_clips: int | None) -> Iterator[Finding]:
        """See `Examinable`; first, how many frames have images that can be used. Damaged files are in the log."""
        usable = [entry for entry in self.entries if self._is_usable(entry)]
        chosen = from_all_over(usable, num_clips)
        number = sum(len(entry.good_frames) for entry in chosen)
        num_seen = sum(len(self._seen(entry, entry.good_frames)[1]) for entry in chosen)
        yield Finding(
            f"images: {num_seen} of {number} frames of {len(chosen)} of {len(usable)} clips can be used; others are "
            f"damaged, or show less than {_LEAST_PIXELS} pixels of a body",
            {"unusable_images": float(number - num_seen)},
        )
        yield from super().examine(bodies, num_clips)

    @cached_property
    def _models(self) -> Any:
        return load_body_models(self.body_path, self.genders)

    @cached_property
    def _bodies(self) -> ClipBodies:
        return ClipBodies(self._models)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_bodies", "_sample")}

    def _is_usable(self, entry: ClipEntry) -> bool:
        return super()._is_usable(entry) and None not in self._sizes[entry.name]

    @cached_property
    def _sizes(self) -> dict[str, list[int | None]]:
        """Of each clip that may have a part the sizes of its files, bytes; None of one that is missing."""
        usable = [entry for entry in self.entries if SurrealSource._is_usable(self, entry)]
        sizes = {
            entry.name: [_size(self.tree / f"{entry.name}{end}") for end in self.files] for entry in usable
        }
        if lacking := [(name, each.index(None)) for name, each in sizes.items() if None in each]:
            name, which = lacking[0]
            _LOG.warning(
                "left out: %d of %d clips, which have not all of %s; the first: there is no %s",
                len(lacking), len(usable), self._named_files, self.tree / f"{name}{self.files[which]}",
            )  # fmt: skip
        return sizes

    @cached_property
    def _sample(self) -> list[tuple[FilmedClip, int, Image]]:
        """Clips from all over the tree, of each a frame and its image."""
        entries = self._parts["test"] or self._parts["train"]
        sample = []
        for entry in from_all_over(entries, _NUM_MEASURED):
            clip, seen = self._seen(entry, entry.good_frames[len(entry.good_frames) // 2 :][:1])
            sample += [(clip, frame, image) for frame, image in seen if clip is not None]
        if not sample:
            raise ValueError(
                f"data.source.path: no *{self.images} in {self.tree} can be read, of {len(entries)} clips; the reasons "
                "are above"
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

    def _masks(self, name: str, frames: Sequence[int]) -> list[np.ndarray]:
        """Where frames of a clip show the body, `(240, 320)` bool, turned back."""
        parts = read_images(self.tree / f"{name}{SEGMENTATION}", "segm", frames)
        return [np.ascontiguousarray((part > 0)[:, ::-1]) for part in parts]

    def _seen(
        self, entry: ClipEntry, frames: np.ndarray
    ) -> tuple[FilmedClip | None, list[tuple[int, Image]]]:
        """A clip, and those of its frames that are whole, each with its image; None where the clip is damaged."""
        try:
            clip = read_filmed_clip(self.tree / f"{entry.name}{INFO}")
            images = self._images(entry.name, frames.tolist(), len(clip))
        except (ValueError, OSError) as error:
            _LOG.warning("left out: %s", error)
            return None, []
        return clip, [
            (int(frame), image)
            for frame, image in zip(frames, images)
            if frame < len(clip) and clip.is_good[frame] and self._num_pixels(image) >= _LEAST_PIXELS
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

    def _filmed(
        self, records: PoseRecords, rows: Sequence[int], with_images: bool
    ) -> tuple[Scene, list[Image]]:
        """The bodies of some records before the camera, without depth images; and their images, where wanted."""
        joints, images = [], []
        for row in rows:
            name, frame = str(records.sequence[row]), int(records.frame[row])
            clip = read_filmed_clip(self.tree / f"{name}{INFO}")
            joints.append(to_camera(clip.joints[frame], clip.camera_place))
            if with_images:
                images += self._images(name, [frame], len(clip))
        pose, betas, gender = (
            torch.from_numpy(values[list(rows)]) for values in (records.pose, records.betas, records.gender)
        )
        scene = Scene(pose, betas, gender, torch.from_numpy(np.stack(joints)), [CAMERA] * len(rows), [])
        return scene, images


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None
