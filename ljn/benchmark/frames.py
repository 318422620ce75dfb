"""What a benchmark's samples and its predictors exchange: frames, truths, and the interface of a set of samples."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from ljn.benchmark.conditions import Condition
from ljn.geometry.camera import Camera


class BenchFrame(NamedTuple):
    """One image of one person, as a predictor is given it.

    Attributes:
        depth: `(H, W)` float32, metres; 0 is background.
        camera: The camera of this image.
        keypoints: `(24, 3)` float32: u, v in pixels and confidence of SMPL's joints; NaN and 0 where one is missing.
            None without any.
        joints: `(24, 3)` float32, metres, camera frame: true joints with noise, of the axis that measures the mesh
            regressor alone; for predictors that read `joints`. None elsewhere.
        num_points: How many points a cloud is to have, for predictors that read `points`; None leaves it to them.
    """

    depth: np.ndarray
    camera: Camera
    keypoints: np.ndarray | None = None
    joints: np.ndarray | None = None
    num_points: int | None = None


class BenchTruth(NamedTuple):
    """What is true of some samples.

    Attributes:
        joints: `(B, 24, 3)` float32, metres, camera frame.
        vertices: `(B, V, 3)` float32, metres, camera frame.
    """

    joints: np.ndarray
    vertices: np.ndarray


class BenchSamples(Protocol):
    """A fixed set of samples, whose every number follows from its definition."""

    @property
    def name(self) -> str:
        """Name and version."""
        ...

    @property
    def facts(self) -> Mapping[str, Any]:
        """What a report says of them: the definition's hash, that of the depth images, and the like."""
        ...

    @property
    def sensors(self) -> Sequence[str]:
        """Names of the sensors that a condition may name."""
        ...

    def __len__(self) -> int:
        """How many there are."""
        ...

    def first(self, num_samples: int) -> Self:
        """The first samples alone."""
        ...

    def identity(self, condition: Condition) -> dict[str, Any]:
        """Plain values on which all frames of a condition depend."""
        ...

    def frames(self, indices: Sequence[int], condition: Condition) -> list[BenchFrame]:
        """What is seen of samples under a condition; the same whatever is asked for beside it."""
        ...

    def truth(self, indices: Sequence[int]) -> BenchTruth:
        """What is true of samples."""
        ...

    def groups(self) -> dict[str, np.ndarray]:
        """Ways to divide the samples: for each `(S,)` str, the name of each sample's group, which sort in order."""
        ...

    def visible(self) -> np.ndarray:
        """`(S, 24)` bool: the clean depth at the joint's pixel is the body's, at most 0.15 m before the joint."""
        ...

    def facing(self) -> np.ndarray:
        """`(S,)` float64: the angle between the body's front and the camera's direction, degrees in [0, 180]."""
        ...

    def clean_depth(self, index: int) -> np.ndarray:
        """`(H, W)` float32, metres: a sample's depth image without noise; 0 is background."""
        ...

    def camera(self, index: int) -> Camera:
        """A sample's camera."""
        ...
