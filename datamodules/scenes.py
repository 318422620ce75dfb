"""Bodies before the camera, as they are rendered: mirrored, and kept for another use."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ljn.body.skeleton import MIRROR, NUM_JOINTS
from ljn.cloud.observation import body_box
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat

# What a mirror makes of x in the camera's and in SMPL's axes, of y in body world, of the vector of a rotation.
_ACROSS, _ACROSS_WORLD, _TURNED = [-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, -1.0, -1.0]


class Scene(NamedTuple):
    """Bodies before the camera.

    Attributes:
        pose: `(B, 72)`, axis-angle in body world, radians.
        betas: `(B, 10)`.
        gender: `(B,)` int64.
        joints: `(B, 24, 3)`, metres, camera frame.
        cameras: The camera of each.
        depth: `(H, W)` float32 of each, metres, without noise; `(0, 0)` where nothing of it is taken.
    """

    pose: Tensor
    betas: Tensor
    gender: Tensor
    joints: Tensor
    cameras: Sequence[Camera]
    depth: list[np.ndarray]


class Frame(NamedTuple):
    """A colour image of one person.

    Attributes:
        rgb: `(H, W, 3)` uint8.
        mask: `(H, W)` bool, where the person is seen.
    """

    rgb: np.ndarray
    mask: np.ndarray


def mirrored(scene: Scene, which: Sequence[bool]) -> Scene:
    """A scene, those of its bodies that `which` says as a mirror shows them: image, camera, joints and pose.

    Shapes stay: the embedded bodies are mirror images of themselves to the last bit, so that a mirrored pose has
    just the mirrored joints and image. Of a body that is not, they differ by as much as its sides do. Images are
    changed in place.
    """
    for image, turn in zip(scene.depth, which):
        if turn:
            image[:] = image[:, ::-1]
    return _mirrored_bodies(scene, which)


def _mirrored_bodies(scene: Scene, which: Sequence[bool]) -> Scene:
    """All of `mirrored` but the images."""
    if not any(which):
        return scene
    is_mirrored = torch.tensor(which)
    joints = scene.joints[:, list(MIRROR)] * scene.joints.new_tensor(_ACROSS)
    return scene._replace(
        pose=torch.where(is_mirrored[:, None], mirrored_pose(scene.pose), scene.pose),
        joints=torch.where(is_mirrored[:, None, None], joints, scene.joints),
        cameras=[
            replace(camera, cx=camera.width - 1 - camera.cx) if turn else camera
            for camera, turn in zip(scene.cameras, which)
        ],
    )


def mirrored_pose(pose: Tensor) -> Tensor:
    """The mirror images of poses `(..., 72)`, axis-angle in body world, radians; the mirror is the plane y = 0."""
    rotvec = pose.unflatten(-1, (NUM_JOINTS, 3))[..., list(MIRROR), :] * pose.new_tensor(_TURNED)
    # The root leads from SMPL's rest frame into body world, whose axes are others.
    root = rotvec_to_rotmat(pose[..., :3])
    root = pose.new_tensor(_ACROSS_WORLD)[:, None] * root * pose.new_tensor(_ACROSS)
    return torch.cat([rotmat_to_rotvec(root), rotvec[..., 1:, :].flatten(-2)], -1)


class KeptScenes:
    """The scenes that were used last, by their keys; of images the bodies' boxes alone, some 0.2 MB a body.

    Args:
        number: How many are kept at most.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self._scenes: OrderedDict[object, tuple[Scene, list[_Box]]] = OrderedDict()

    def get(self, key: object, which: Sequence[bool]) -> Scene | None:
        """The scene of that key as `mirrored` gives it, its images free to be changed; None where it is not kept."""
        if key not in self._scenes:
            return None
        self._scenes.move_to_end(key)
        scene, boxes = self._scenes[key]
        depth = [np.zeros(box.shape, np.float32) for box in boxes]
        for image, box, turn in zip(depth, boxes, which):
            height, width = box.depth.shape
            columns = image[:, ::-1] if turn else image
            columns[box.top : box.top + height, box.left : box.left + width] = box.depth
        return _mirrored_bodies(scene, which)._replace(depth=depth)

    def put(self, key: object, scene: Scene) -> None:
        """Keep a scene, and forget the one that was used least recently where there are too many."""
        if not self.number:
            return
        boxes = [_boxed(image) for image in scene.depth]
        self._scenes[key] = scene._replace(depth=[]), boxes
        while len(self._scenes) > self.number:
            self._scenes.popitem(last=False)


class _Box(NamedTuple):
    """The part of an image around a body, its place in the image, and the image's shape."""

    shape: tuple[int, ...]
    top: int
    left: int
    depth: np.ndarray


def _boxed(image: np.ndarray) -> _Box:
    left, right, top, bottom = body_box(image)  # of an empty image empty, too
    return _Box(image.shape, top, left, image[top : bottom + 1, left : right + 1].copy())
