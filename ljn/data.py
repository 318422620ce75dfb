"""The contract between data, models and tasks: what a batch holds, what a data module can say of itself."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, TypedDict

from lightning.pytorch import LightningDataModule
from torch import Tensor

from ljn.body import BodyModel

EMBEDDED_DATA_VERSION = 1
"""Raised with every change of the embedded bodies, of the poses generated from the embedded clips, or of the samples
made of them, because results are comparable within a version only. A test holds their hashes."""

SPLITS = ("train", "val", "test")


class Batch(TypedDict):
    """A batch of samples; camera frame, metres and pixels.

    Keys:
        points: `(B, N, 6)` float32: position in metres and unit normal of each point, in random order.
        keypoints_2d: `(B, 24, 2)`, true joints projected, pixels.
        noisy_keypoints_2d: `(B, 24, 2)`, keypoints with noise, clipped to the image.
        initial_joints: `(B, 24, 3)`, noisy keypoints lifted with the depth image, metres.
        joints: `(B, 24, 3)`, true joints, metres.
        pose: `(B, 72)`, axis-angle in the body world, heading included, radians.
        betas: `(B, 10)`, shape coefficients.
        gender: `(B,)` int64, codes of `ljn.body.GENDERS`.
        camera: `(B, 4)`: fx, fy, cx, cy, pixels.
        sample_id: `(B,)` int64, the record's number in its split.
    """

    points: Tensor
    keypoints_2d: Tensor
    noisy_keypoints_2d: Tensor
    initial_joints: Tensor
    joints: Tensor
    pose: Tensor
    betas: Tensor
    gender: Tensor
    camera: Tensor
    sample_id: Tensor


class BodyDataModule(LightningDataModule):
    """Base of the data modules, whose loaders give `Batch`es: what tasks ask beside that."""

    @property
    @abstractmethod
    def bodies(self) -> tuple[BodyModel, ...]:
        """The bodies that the data shows, one for each gender."""

    @property
    def body_hash(self) -> str:
        """The bodies' sorted hashes, joined by "-": see `SMPL.hash`."""
        return "-".join(sorted(body.hash for body in self.bodies))

    @property
    @abstractmethod
    def fingerprint(self) -> str:
        """Hash of what the data's files and its code make of its settings: the body, the poses, their version."""

    @property
    @abstractmethod
    def licence(self) -> str:
        """Where the data comes from and what may be done with it: goes into checkpoints."""

    @abstractmethod
    def examples(self, split: str, indices: Sequence[int]) -> tuple[Batch, Tensor]:
        """Samples of a split by their numbers, and the depth images `(B, H, W)`, metres, that they were taken from.

        Training samples are those of the first epoch.

        Raises:
            ValueError: The split has no such sample.
        """

    @abstractmethod
    def describe(self, splits: Sequence[str] = SPLITS) -> dict[str, Any]:
        """Source, bodies, sizes, each split's motion capture, the hash of its poses and the like: goes into records.

        Args:
            splits: The splits that the run reads.
        """
