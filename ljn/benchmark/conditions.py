"""Under what conditions samples are seen: the base, and the axes along which one thing of it changes."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple, Self

REFERENCE_FOCAL_PX = 366.458
"""Noise of keypoints is given for this focal length, that of a Kinect v2, and grows with a sample's own."""


@dataclass(frozen=True)
class Condition:
    """How samples are seen. The defaults are the base condition.

    Attributes:
        keypoint_noise_px: Standard deviation of the keypoints' Gaussian noise on u and on v, pixels at
            `REFERENCE_FOCAL_PX`; None: there are no keypoints.
        missing_percent: Of the keypoints, percent that are missing: a whole number of the 24, drawn for each sample.
        joint_noise_mm: Of the true joints given to a mesh regressor alone: standard deviation of the Gaussian noise
            along each axis, millimetres; None: none are given.
        num_points: Points of a cloud; None: the predictor's own.
        occluded_percent: Of the body's pixels, percent that a box at a random place hides.
        sensor: Which sensor takes the image; None: noise of 1 mm alone.
    """

    keypoint_noise_px: float | None = 10.0
    missing_percent: float = 0.0
    joint_noise_mm: float | None = None
    num_points: int | None = None
    occluded_percent: float = 0.0
    sensor: str | None = None

    @property
    def has_keypoints(self) -> bool:
        """Whether keypoints are given."""
        return self.keypoint_noise_px is not None

    @property
    def without_keypoints(self) -> Self:
        """The same without keypoints."""
        return replace(self, keypoint_noise_px=None, missing_percent=0.0)

    @property
    def changes(self) -> dict[str, Any]:
        """What differs from the base, by name."""
        base = asdict(BASE)
        return {name: value for name, value in asdict(self).items() if value != base[name]}


BASE = Condition()


def _with_missing(condition: Condition, value: Any) -> Condition:
    if value >= 100:  # none is left
        return condition.without_keypoints
    return replace(condition, missing_percent=float(value))


class Axis(NamedTuple):
    """One thing that changes, and its values.

    Attributes:
        name: For files.
        label: For tables and charts, with the unit.
        values: In the order that tables show them; numbers, or names.
        change: The condition with that value.
        reads: What a predictor has to read for the axis to mean anything to it: `keypoints`, `joints` or `points`; ""
            where it is the image that changes.
        is_of_mesh: Whether it is the mesh that it measures.
    """

    name: str
    label: str
    values: Sequence[Any]
    change: Callable[[Condition, Any], Condition]
    reads: str = ""
    is_of_mesh: bool = False


AXES: tuple[Axis, ...] = (
    Axis(
        "keypoint_noise",
        "noise of the 2D keypoints, px",
        (0, 5, 10, 15, 20, 30),
        lambda condition, value: replace(condition, keypoint_noise_px=float(value)),
        reads="keypoints",
    ),
    Axis("missing", "missing keypoints, %", (0, 25, 50, 75, 100), _with_missing, reads="keypoints"),
    Axis(
        "joint_noise",
        "noise of the mesh regressor's joints, mm",
        (0, 10, 20, 30, 50),
        lambda condition, value: replace(condition, joint_noise_mm=float(value)),
        reads="joints",
        is_of_mesh=True,
    ),
    Axis(
        "points",
        "points of the cloud",
        (256, 512, 1024, 2048, 4096, 8192),
        lambda condition, value: replace(condition, num_points=int(value)),
        reads="points",
    ),
    Axis(
        "occlusion",
        "body's pixels hidden by a box, %",
        (0, 10, 20, 30, 40),
        lambda condition, value: replace(condition, occluded_percent=float(value)),
    ),
)
"""The axes of every benchmark. A new one is a row here, and a field of `Condition` that the samples heed."""


def sensor_axis(names: Sequence[str]) -> Axis:
    """The axis of the sensors of these names; the base's noise, `none`, comes first."""
    return Axis(
        "sensor",
        "sensor",
        ("none", *names),
        lambda condition, value: condition if value == "none" else replace(condition, sensor=value),
    )


class Step(NamedTuple):
    """A value of an axis, for predictions with keypoints or without."""

    axis: Axis
    value: Any
    with_keypoints: bool
    condition: Condition


def steps_of(axis: Axis) -> list[Step]:
    """An axis's steps: where keypoints play no part in it, with them and without."""
    starts = [BASE] if axis.reads in ("keypoints", "joints") else [BASE, BASE.without_keypoints]
    return [
        Step(axis, value, start.has_keypoints, axis.change(start, value))
        for start in starts
        for value in axis.values
    ]
