"""From a colour frame that somebody else has made to a crop, such as those that are rendered."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch

from datamodules.posing import SampleKey
from datamodules.rgb.synthesis import BACKGROUND, FINER, Picture, RgbSynthesizer, Variation
from datamodules.scenes import Frame, Scene
from datamodules.sources import FrameSource, PoseRecords
from ljn.cloud.rgb import Window
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import rotation_about, rotmat_to_rotvec, rotvec_to_rotmat


class FrameSynthesizer(RgbSynthesizer):
    """Crops of records that have colour frames of their own: nothing is rendered but a background, where one is wanted.

    Args:
        source: Where the frames come from.
        records: Its records.
        others: As `RgbSynthesizer`; of the settings, those of a crop's variation count.
    """

    def __init__(self, source: FrameSource, records: PoseRecords, *others: Any) -> None:
        super().__init__(records, *others)
        self.records = records  # with the headings that the frames show
        self.source = source

    def _pictures(
        self, keys: Sequence[SampleKey], variations: Sequence[Variation]
    ) -> tuple[Scene, list[Picture]]:
        scene, frames = self.source.filmed(self.records, [index for _, index in keys])
        roll = torch.tensor([variation.roll for variation in variations], dtype=torch.float64)
        turn = rotation_about("z", -roll)  # the camera's z is the body world's x turned round
        pictures = [
            self._crop(key, variation, frame, camera, matrix)
            for key, variation, frame, camera, matrix in zip(
                keys, variations, frames, scene.cameras, turn.numpy()
            )
        ]
        root = rotation_about("x", roll).to(scene.pose) @ rotvec_to_rotmat(scene.pose[:, :3])
        pose = torch.cat([rotmat_to_rotvec(root), scene.pose[:, 3:]], -1)
        return scene._replace(pose=pose, joints=scene.joints @ turn.to(scene.joints).mT), pictures

    def _crop(
        self, key: SampleKey, variation: Variation, frame: Frame, camera: Camera, turn: np.ndarray
    ) -> Picture:
        """The crop of a frame as a camera sees it that is turned about its axis, by `(3, 3)`."""
        focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        turned = turn[:2, :2] * focal[:, None] / focal  # of pixels, from the image's centre
        rows, columns = np.nonzero(frame.mask)
        body = (np.stack([columns, rows], -1) - centre) @ turned.T + centre
        (left, top), (right, bottom) = body.min(0), body.max(0)
        window = self._window((left, right, top, bottom), variation)
        height, width = self.recipe.height_px, self.recipe.width_px
        crop = self._seen(key, frame, _map(window, turned, centre, (FINER * height, FINER * width)))
        own = window.intrinsics(np.concatenate([focal, centre]), width, height)
        return Picture(crop.transpose(2, 0, 1), own)

    def _seen(self, key: SampleKey, frame: Frame, matrix: np.ndarray) -> np.ndarray:
        """`(h, w, 3)` uint8: the person and what is behind, by the map `(2, 3)` of the crop's finer pixels."""
        size = self.recipe.width_px, self.recipe.height_px
        fine = FINER * size[0], FINER * size[1]

        def taken(image: np.ndarray) -> np.ndarray:
            seen = cv2.warpAffine(image, matrix, fine, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            return cv2.resize(seen, size, interpolation=cv2.INTER_AREA)

        if self.background.kind == "own":
            return taken(frame.rgb)
        person = taken(frame.rgb * frame.mask[..., None])
        if self.background.kind == "black":
            return person
        behind = self.background.image(size[1], size[0], self._rng(key, BACKGROUND))
        share = taken(frame.mask.astype(np.float32))[..., None]
        return np.rint(person + 255 * (1 - share) * behind).clip(0, 255).astype(np.uint8)


def _map(window: Window, turned: np.ndarray, centre: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Where in an image the pixels of a window with so many rows and columns lie, `(2, 3)`; the window is of the image
    turned by `(2, 2)` about its centre.
    """
    steps = np.array([window.width / size[1], window.height / size[0]])
    first = np.array([window.left, window.top]) + steps / 2 - 0.5
    back = np.linalg.inv(turned)
    return np.column_stack([back * steps, back @ (first - centre) + centre])
