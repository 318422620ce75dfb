"""2D keypoints that nobody gave: found in the colour or the depth image by a keypoint detector."""

from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from ljn.cloud.observation import observe, stack_observations
from ljn.cloud.rgb import crop_rgb
from ljn.geometry.camera import Camera, transfer
from ljn.modules.keypoint_detector import KeypointDetector
from ljn.pipeline.keypoints import MIN_CONFIDENCE, Keypoints
from ljn.pipeline.stages import Stage, load_stage
from ljn.runs.packages import find_package, is_package, shipped


class KeypointFinder:
    """Finds the keypoints of the person in an image.

    Args:
        stage: A keypoint detector.
    """

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.sees: str = stage.module.net.sees

    @classmethod
    def load(
        cls, path: str | Path, device: str | torch.device = "cpu", name: str = "keypoint_detector"
    ) -> Self:
        """That of a checkpoint or of a package.

        Args:
            path: A checkpoint's file, or a package's; or the name of one that ships.
            device: Where the network runs.
            name: What errors call `path`.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is damaged, or holds no keypoint detector.
        """
        if is_package(path) or str(path) in shipped():
            path = find_package(path, name)
        return cls(load_stage(path, KeypointDetector, name, device, of_colour=True)[0])

    @torch.inference_mode()
    def __call__(self, depth: np.ndarray, camera: Camera, rgb: Any = None) -> Keypoints:
        """The keypoints in one image.

        Args:
            depth: `(H, W)` float32, metres; 0 where the person is not.
            camera: The camera of the image.
            rgb: `(H, W, 3)` uint8, red, green, blue, registered to the depth image; for a detector that `sees` it.

        Returns:
            All 24; those of a confidence under `MIN_CONFIDENCE` with 0 in its place.

        Raises:
            ValueError: The colour image is missing, or not such an image.
        """
        module, recipe = self.stage.module, self.stage.recipe
        if self.sees == "depth":
            made = observe(depth, camera, None, recipe, module.takes, np.random.default_rng(0))
            image, crop_camera = stack_observations([made]).values()
        else:
            crop, intrinsics = crop_rgb(registered_rgb(rgb, camera), depth > 0, camera, recipe)
            image, crop_camera = torch.from_numpy(crop)[None], torch.from_numpy(intrinsics)[None]
        found = module.net(image.to(module.device))
        positions = transfer(found.keypoints.cpu(), crop_camera, camera.intrinsics()[None])[0]
        confidences = found.confidences[0].cpu()
        confidences = torch.where(confidences < MIN_CONFIDENCE, 0.0, confidences)
        return Keypoints(positions.float().numpy(), confidences.float().numpy())


def registered_rgb(rgb: Any, camera: Camera) -> np.ndarray:
    """A colour image `(H, W, 3)` uint8 that belongs to the camera's depth images; a fourth channel is left out.

    Raises:
        ValueError: There is none, or it is not such an image.
    """
    expected = (
        f"rgb: expected uint8 of shape ({camera.height}, {camera.width}, 3), red, green and blue, registered to the "
        "depth image pixel by pixel"
    )
    if rgb is None:
        raise ValueError(f"{expected}, in which this keypoint detector finds the joints, got none")
    rgb = np.asarray(rgb)
    if (
        rgb.shape not in ((camera.height, camera.width, channels) for channels in (3, 4))
        or rgb.dtype != np.uint8
    ):
        raise ValueError(f"{expected}, got {rgb.dtype} of shape {rgb.shape}")
    return rgb[..., :3]
