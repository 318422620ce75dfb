"""Sources of poses. Each yields `PoseRecords` for a split; how they are rendered is not its concern."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from datamodules.scenes import Frame, Scene
from ljn.body import BodyModel
from ljn.body.kinematics import without_heading
from ljn.body.skeleton import NUM_JOINTS
from ljn.data import SPLITS, Finding
from ljn.geometry.rotations import BODY_TO_OPENGL, rotmat_to_rotvec, rotvec_to_rotmat

__all__ = ["SPLITS", "Examinable", "FrameSource", "ImageSource", "PoseRecords", "PoseSource"]

_HASH_STEP = 1e-5


@dataclass(frozen=True)
class PoseRecords:
    """A table of poses and shapes, a row each.

    Attributes:
        pose: `(R, 72)` float32 axis-angle, radians; the first three place the body in the body world (z up,
            x forward), heading included where `has_heading`.
        betas: `(R, 10)` float32 shape coefficients.
        gender: `(R,)` int64, codes of `ljn.body.GENDERS`.
        sequence: `(R,)` str, the clip that the pose came from, or what it was made of.
        frame: `(R,)` int64, the frame in that clip; -1 where there is none.
        has_heading: Whether the first rotation still holds the heading that was recorded.
    """

    pose: np.ndarray
    betas: np.ndarray
    gender: np.ndarray
    sequence: np.ndarray
    frame: np.ndarray
    has_heading: bool

    def __post_init__(self) -> None:
        shapes = {"pose": (3 * NUM_JOINTS,), "betas": (10,), "gender": (), "sequence": (), "frame": ()}
        for name, tail in shapes.items():
            got = getattr(self, name).shape
            if got != (len(self.pose), *tail):
                raise ValueError(
                    f"{name}: expected shape {('R', *tail)} with R = {len(self.pose)}, got {got}"
                )
        for name in ("pose", "betas"):
            if len(bad := np.flatnonzero(~np.isfinite(getattr(self, name)).all(-1))):
                raise ValueError(
                    f"{name}: NaN or infinite values in {len(bad)} of {len(self)} records, the first in "
                    f"record {bad[0]} (sequence '{self.sequence[bad[0]]}'); drop or repair them"
                )

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def kinds(self) -> np.ndarray:
        """`(R,)` str: of a procedural pose its family, else `clip` or, of parts from several donors, `recombined`."""

        def kind(name: str) -> str:
            if "|" in name:
                return "recombined"
            return name.removeprefix("proc/") if name.startswith("proc/") else "clip"

        kinds = [kind(name) for name in self.sequence.tolist()]
        return np.array(kinds, dtype=str)

    def without_heading(self) -> "PoseRecords":
        """The same records with headings dropped, for others to be drawn; themselves where they have none."""
        if not self.has_heading:
            return self
        rotmat = BODY_TO_OPENGL @ rotvec_to_rotmat(torch.from_numpy(self.pose[:, :3]).double())
        root = rotmat_to_rotvec(BODY_TO_OPENGL.T @ without_heading(rotmat)).numpy().astype(np.float32)
        return replace(self, pose=np.concatenate([root, self.pose[:, 3:]], 1), has_heading=False)

    @cached_property
    def hash(self) -> str:
        """Name of the table's content: the first 16 hex digits of a SHA-256 over all columns, row by row.

        Pose and betas enter as whole numbers of steps of 1e-5 (radians; standard deviations). Rounding, which differs
        between machines, does not change it, unless a value lies just between two steps.
        """
        digest = hashlib.sha256(f"{len(self)} {self.has_heading}".encode())
        for values in (self.pose, self.betas):
            digest.update(np.rint(values.astype(np.float64) / _HASH_STEP).astype("<i8").tobytes())
        for codes in (self.gender, self.frame):
            digest.update(codes.astype("<i8").tobytes())
        digest.update("\n".join(self.sequence.tolist()).encode())
        return digest.hexdigest()[:16]


class PoseSource(Protocol):
    """What a source of poses offers.

    Attributes:
        cache_dir: Where it may keep what it makes of its files; None for nowhere. A data module sets it to its own.
    """

    cache_dir: Path | None

    @property
    def name(self) -> str:
        """Name for records and reports."""
        ...

    @property
    def version(self) -> int:
        """Raised with every change of the records that its code makes of the same files."""
        ...

    @property
    def fingerprint(self) -> str:
        """Hash of all that its records depend on, except the seed: files, splits, settings."""
        ...

    @property
    def licence(self) -> str:
        """One line on where the poses come from and what may be done with them."""
        ...

    @property
    def genders(self) -> Sequence[str]:
        """The genders that its records may have, keys of `ljn.body.GENDERS`: a body is loaded for each."""
        ...

    def check(self) -> None:
        """Raise `FileNotFoundError` or `ValueError` where its files are missing or damaged."""
        ...

    def motion(self, split: str) -> Mapping[str, int]:
        """How much motion capture a split's poses are made from: `clips`, `frames` and what else is known of it."""
        ...

    def records(self, split: str, num_records: int, seed: int) -> PoseRecords:
        """`num_records` records of a split (one of `SPLITS`); the same ones for the same seed."""
        ...


@runtime_checkable
class ImageSource(Protocol):
    """A `PoseSource` whose records have depth images of their own, which are taken in place of rendered ones."""

    def scene(self, records: PoseRecords, rows: Sequence[int], with_depth: bool) -> Scene:
        """The bodies of some records before the camera that saw them; without `with_depth` images are `(0, 0)`."""
        ...


@runtime_checkable
class FrameSource(Protocol):
    """A `PoseSource` whose records have colour frames of their own, which are taken in place of rendered pictures."""

    def filmed(self, records: PoseRecords, rows: Sequence[int]) -> tuple[Scene, list[Frame]]:
        """The bodies of some records before the camera that saw them, without depth, and the frame of each."""
        ...


@runtime_checkable
class Examinable(Protocol):
    """A `PoseSource` that can hold what its files say against itself."""

    def examine(self, bodies: Sequence[BodyModel], num_clips: int | None) -> Iterator[Finding]:
        """What is found in so many clips from all over its files, or in all of them; with these bodies."""
        ...
