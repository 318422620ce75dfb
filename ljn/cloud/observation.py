"""What a network takes of a depth image: the one place where it is made, for training and for prediction alike."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict, cast

import numba
import numpy as np
import torch
from torch import Tensor

from ljn.body.skeleton import MIRROR, NUM_JOINTS
from ljn.cloud.lifting import lift_keypoints
from ljn.cloud.normals import NORMALS, get_normal_estimator
from ljn.cloud.sampling import sample_cloud
from ljn.geometry.camera import Camera

PARTS = ("points", "crop", "crop_camera", "keypoints", "confidences", "initial_joints")
"""What an observation may hold; a network names, in its `takes`, which of them it is called with."""
_CROP_MARGIN, _CROP_BORDER_PX = (
    1.1,
    4,
)  # the square around the body's box: its longer side times this, plus this


class Observation(TypedDict, total=False):
    """What can be seen of a person in one depth image; float32, metres in the camera frame, pixels.

    Keys:
        points: `(N, 6)`: position and unit normal of each point, in random order.
        crop: `(P, P)`: the depth of a square around the body, 0 where it is not seen.
        crop_camera: `(4,)`: fx, fy, cx, cy of the crop, in its own pixels; the camera frame is that of the image.
        keypoints: `(24, 2)`: u and v of the 2D joints, clipped to the image.
        confidences: `(24,)`: of the keypoints; 0 where there is none, and what stands in its place is a guess.
        initial_joints: `(24, 3)`: the keypoints lifted with the depth image.
    """

    points: np.ndarray
    crop: np.ndarray
    crop_camera: np.ndarray
    keypoints: np.ndarray
    confidences: np.ndarray
    initial_joints: np.ndarray


@dataclass(frozen=True)
class ObservationRecipe:
    """How an observation is made. It travels with a model's weights: a model is only meaningful with its recipe.

    Attributes:
        num_points: Points in a cloud.
        normals: One of `ljn.cloud.normals.NORMALS`.
        crop_px: Side of the crop, pixels.
        spacing_m: The least distance in space between neighbouring pixels in training, metres: that of the nearest
            bodies. Denser images are thinned; None thins nothing.
    """

    num_points: int = 4096
    normals: str = "window"
    crop_px: int = 128
    spacing_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("num_points", "crop_px"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if self.crop_px % 2:
            raise ValueError(f"crop_px: expected an even number, which can be halved, got {self.crop_px}")
        if self.normals not in NORMALS:
            raise ValueError(f"normals: expected one of {', '.join(NORMALS)}, got '{self.normals}'")
        if self.spacing_m is not None and not 0 < self.spacing_m < np.inf:
            raise ValueError(f"spacing_m: expected a positive number or none, got {self.spacing_m}")


def observe(
    depth: np.ndarray,
    camera: Camera,
    keypoints: np.ndarray | None,
    recipe: ObservationRecipe,
    takes: Collection[str],
    rng: np.random.Generator,
    confidences: np.ndarray | None = None,
) -> Observation:
    """Make what a network takes of one depth image.

    A cloud's normals from a window of the image cover a patch of the body whose size follows from the pixels' spacing
    in space, depth over focal length. Where that is less than half of `recipe.spacing_m`, every second pixel, or third,
    or so on, is used, which brings patches and sensor noise back to what was trained.

    Args:
        depth: `(H, W)` float32, metres; 0 is background.
        camera: The camera of this image.
        keypoints: `(24, 2)`, u and v, pixels, finite; None where there are none: all in the middle of the body then, of
            confidence 0, for a network that takes confidences.
        recipe: How it is made.
        takes: Which of `PARTS` to make.
        rng: Source of the choice of points.
        confidences: `(24,)`, of the keypoints; None: all 1.

    Raises:
        ValueError: The mask is empty, `takes` names something else, or keypoints are wanted and there are none.
    """
    if unknown := set(takes) - set(PARTS):
        raise ValueError(f"takes: expected some of {', '.join(PARTS)}, got {', '.join(sorted(unknown))}")
    made = Observation()
    if "points" in takes:
        made["points"] = _cloud(depth, camera, recipe, rng)
    if "crop" in takes or "crop_camera" in takes:
        made["crop"], made["crop_camera"] = crop_body(depth, camera, recipe.crop_px)
    if {"keypoints", "confidences", "initial_joints"} & set(takes):
        if keypoints is None:
            if "confidences" not in takes:
                raise ValueError(
                    "keypoints: expected those of the 24 joints, which this network takes, got none"
                )
            keypoints, confidences = _no_keypoints(depth)
        corner = np.array([camera.width - 1, camera.height - 1], np.float32)
        made["keypoints"] = np.asarray(keypoints, np.float32).clip(0, corner)
    if "confidences" in takes:
        is_there = np.ones(NUM_JOINTS) if confidences is None else confidences
        made["confidences"] = np.asarray(is_there, np.float32)
    if "initial_joints" in takes:
        made["initial_joints"] = lift_keypoints(made["keypoints"], depth, camera)
    return made


def stack_observations(observations: Sequence[Observation]) -> dict[str, Tensor]:
    """Observations of the same parts as a batch of tensors, each with a leading dimension B."""
    made = [cast(dict[str, np.ndarray], observation) for observation in observations]
    return {name: torch.from_numpy(np.stack([each[name] for each in made])) for name in made[0]}


MIRRORED = frozenset(PARTS) - {"keypoints"}
"""The parts that can be mirrored; keypoints would need the image's size."""


def mirror_observations(seen: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A batch of observations as a mirror shows them, left and right exchanged; its parts that are in `MIRRORED`.

    The mirror is the plane x = 0 of the camera frame. Twice mirrored, joints are back where they were.
    """
    made = {name: value for name, value in seen.items() if name in MIRRORED}
    across = {
        name: made[name].new_tensor([-1.0, 1, 1]) for name in ("points", "initial_joints") if name in made
    }
    if "points" in made:
        made["points"] = made["points"] * across["points"].repeat(2)
    if "initial_joints" in made:
        made["initial_joints"] = made["initial_joints"][:, list(MIRROR)] * across["initial_joints"]
    if "confidences" in made:
        made["confidences"] = made["confidences"][:, list(MIRROR)]
    if "crop" in made:
        made["crop"] = made["crop"].flip(-1)
        fx, fy, cx, cy = made["crop_camera"].unbind(-1)
        made["crop_camera"] = torch.stack([fx, fy, made["crop"].shape[-1] - 1 - cx, cy], -1)
    return made


def crop_body(depth: np.ndarray, camera: Camera, size_px: int) -> tuple[np.ndarray, np.ndarray]:
    """A square of the depth image around the body, resampled to `size_px` pixels a side, the nearest of each.

    Args:
        depth: `(H, W)` float32, metres; 0 is background.
        camera: The camera of this image.
        size_px: Side of the crop.

    Returns:
        `(P, P)` float32, metres, 0 outside the body; and `(4,)` float32: fx, fy, cx, cy of the crop.

    Raises:
        ValueError: The mask is empty.
    """
    left, right, top, bottom = body_box(depth)
    if right < left:
        raise ValueError("depth: the mask is empty, no pixel shows the body")
    side = _CROP_MARGIN * max(right - left, bottom - top) + _CROP_BORDER_PX
    step = side / size_px
    u, v = (
        (left + right + 1 - side) / 2,
        (top + bottom + 1 - side) / 2,
    )  # the square's corner; pixel k is [k, k + 1)
    intrinsics = [
        camera.fx / step,
        camera.fy / step,
        (camera.cx + 0.5 - u) / step - 0.5,
        (camera.cy + 0.5 - v) / step - 0.5,
    ]
    return _resample(depth, u, v, step, size_px), np.array(intrinsics, np.float32)


def _cloud(
    depth: np.ndarray, camera: Camera, recipe: ObservationRecipe, rng: np.random.Generator
) -> np.ndarray:
    """`(N, 6)` float32: position and normal."""
    if recipe.spacing_m is not None and (depth > 0).any():
        spacing = float(np.median(depth[depth > 0])) / camera.fx
        depth, camera = _every(max(1, int(recipe.spacing_m / spacing)), depth, camera)
    cloud = sample_cloud(depth, camera, recipe.num_points, rng)
    normals = get_normal_estimator(recipe.normals)(cloud, depth, camera)
    return np.concatenate([cloud.points, normals], -1)


def _no_keypoints(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints in the middle of the body, and their confidences of 0."""
    left, right, top, bottom = body_box(depth)
    middle = np.array([(left + right) / 2, (top + bottom) / 2], np.float32)
    return np.tile(middle, (NUM_JOINTS, 1)), np.zeros(NUM_JOINTS)


def _every(step: int, depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Every `step`-th row and column of an image, and the camera that sees just these."""
    if step == 1:
        return depth, camera
    thinned = np.ascontiguousarray(depth[::step, ::step])
    height, width = thinned.shape
    return thinned, Camera(
        camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step, width, height
    )


@numba.njit(cache=True, nogil=True)
def body_box(depth: np.ndarray) -> tuple[int, int, int, int]:
    """First and last column, first and last row of a body in a depth image; the last before the first without one."""
    height, width = depth.shape
    left, right, top, bottom = width, -1, height, -1
    for v in range(height):
        is_empty = True
        for u in range(width):  # without a jump, some pixels at once
            is_empty &= not depth[v, u] > 0
        if is_empty:
            continue
        top, bottom = min(top, v), v
        for u in range(left):
            if depth[v, u] > 0:
                left = u
                break
        for u in range(width - 1, right, -1):
            if depth[v, u] > 0:
                right = u
                break
    return left, right, top, bottom


@numba.njit(cache=True, nogil=True)
def _resample(depth: np.ndarray, u: float, v: float, step: float, size: int) -> np.ndarray:
    """The pixels in the middles of a grid of `size` x `size` cells, `step` wide, whose corner is at (u, v)."""
    height, width = depth.shape
    crop = np.zeros((size, size), np.float32)
    for i in range(size):
        row = int(np.floor(v + (i + 0.5) * step))
        if not 0 <= row < height:
            continue
        for j in range(size):
            column = int(np.floor(u + (j + 0.5) * step))
            if 0 <= column < width:
                crop[i, j] = depth[row, column]
    return crop
