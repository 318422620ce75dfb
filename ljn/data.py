"""The contract between data, models and tasks: what a batch holds, what a data module can say of itself."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict

import numpy as np
import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor

from ljn.body import BodyModel

if TYPE_CHECKING:
    from ljn.cloud.observation import ObservationRecipe
    from ljn.cloud.rgb import RgbRecipe

SPLITS = ("train", "val", "test")


class Batch(TypedDict, total=False):
    """A batch of samples: observations (see `Observation`; of its parts, those that the network takes) and the truth.

    Keys:
        points: `(B, N, 6)`.
        crop: `(B, P, P)`.
        crop_camera: `(B, 4)`.
        rgb: `(B, 3, h, w)` uint8, a colour crop; see `ljn.cloud.rgb`.
        rgb_camera: `(B, 4)`: fx, fy, cx, cy of that crop, in its own pixels.
        keypoints: `(B, 24, 2)`, with noise.
        confidences: `(B, 24)`, 0 where a keypoint is missing.
        initial_joints: `(B, 24, 3)`: keypoints lifted with the depth image, or what stands in their place.
        lifted_joints: `(B, 24, 3)`: where a detector has moved the initial joints, those that it was given.
        true_keypoints: `(B, 24, 2)`, true joints projected, pixels.
        joints: `(B, 24, 3)`, true joints, metres, camera frame.
        pose: `(B, 72)`, axis-angle in the body world, heading included, radians.
        betas: `(B, 10)`, shape coefficients.
        gender: `(B,)` int64, codes of `ljn.body.GENDERS`.
        camera: `(B, 4)`: fx, fy, cx, cy, pixels.
        sample_id: `(B,)` int64, the record's number in its split.
    """

    points: Tensor
    crop: Tensor
    crop_camera: Tensor
    rgb: Tensor
    rgb_camera: Tensor
    keypoints: Tensor
    confidences: Tensor
    initial_joints: Tensor
    lifted_joints: Tensor
    true_keypoints: Tensor
    joints: Tensor
    pose: Tensor
    betas: Tensor
    gender: Tensor
    camera: Tensor
    sample_id: Tensor


class Finding(NamedTuple):
    """What an examination of data has found in one place.

    Attributes:
        text: A line for the user.
        values: Numbers by name; of all findings' numbers of one name, the largest counts.
        is_wrong: Whether the data cannot be used as they are.
    """

    text: str
    values: Mapping[str, float]
    is_wrong: bool = False


class DataModule(LightningDataModule):
    """Base of the data modules: what tasks ask of one beside its loaders.

    Attributes:
        takes: What of an observation the network takes, which the batches are to hold; set before `setup`.
    """

    takes: tuple[str, ...] = ("points", "initial_joints")

    @property
    def bodies(self) -> tuple[BodyModel, ...]:
        """The bodies that the data shows, one for each gender; none where it shows no body of SMPL's form."""
        return ()

    @property
    def recipe(self) -> "ObservationRecipe | RgbRecipe | None":
        """How its observations are made, and what was trained with them: goes into checkpoints."""
        return None

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
        """Samples of a split by their numbers, and what they were taken from: depth images `(B, H, W)`, metres, or, of
        samples in colour, their crops `(B, 3, h, w)` uint8.

        Training samples are those of the first epoch.

        Raises:
            ValueError: The split has no such sample.
        """

    @property
    def detector(self) -> torch.nn.Module | None:
        """The joint detector whose joints stand in place of the initial ones; None without one."""
        return None

    @property
    def detector_file(self) -> Path | None:
        """The file of that detector: its content goes into checkpoints."""
        return None

    def groups(self, split: str) -> dict[str, np.ndarray]:
        """Kinds of samples, in whose errors one may be interested: for each way to divide a split, `(S,)` str, the name
        of each sample's kind, in the order of their numbers.
        """
        return {}

    def examine(self, number: int | None) -> Iterator[Finding]:
        """What is found when the data's files are held against themselves; nothing where there is nothing to compare.

        Args:
            number: How many clips or frames to look at; None: all.
        """
        yield from ()

    @abstractmethod
    def describe(self, splits: Sequence[str] = SPLITS) -> dict[str, Any]:
        """Source, bodies, sizes, each split's motion capture, the hash of its poses and the like: goes into records.

        Args:
            splits: The splits that the run reads.
        """
