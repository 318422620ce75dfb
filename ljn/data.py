"""The contract between data, models and tasks: what a batch holds, what a data module can say of itself."""

from abc import abstractmethod
from typing import Any, TypedDict

from lightning.pytorch import LightningDataModule
from torch import Tensor

from ljn.body import BodyModel


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
    def body(self) -> BodyModel:
        """The body that the data shows."""

    @property
    @abstractmethod
    def fingerprint(self) -> str:
        """Hash of what the data's files and its code make of its settings: the body, the poses, their version."""

    @property
    @abstractmethod
    def licence(self) -> str:
        """Where the data comes from and what may be done with it: goes into checkpoints."""

    @abstractmethod
    def examples(self, num_samples: int) -> tuple[Batch, Tensor]:
        """The first training samples, and the depth images `(B, H, W)`, metres, that they were taken from."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Source, fingerprint, sizes and the like: goes into records."""
