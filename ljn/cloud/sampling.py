"""The random choice of the pixels that become points."""

from typing import NamedTuple

import numpy as np
import torch

from ljn.geometry.camera import Camera, back_project


class Cloud(NamedTuple):
    """A point cloud and the pixels that it came from.

    Attributes:
        points: `(N, 3)` float32, metres, camera frame.
        pixels: `(N, 2)` int64, column u and row v of each point.
    """

    points: np.ndarray
    pixels: np.ndarray


def sample_cloud(depth: np.ndarray, camera: Camera, num_points: int, rng: np.random.Generator) -> Cloud:
    """Back-project `num_points` random pixels of the body, in random order.

    Pixels are chosen first and only those are back-projected. No pixel comes twice unless the mask has fewer
    than `num_points`: then each comes once and the rest are drawn again with replacement. A smaller
    `num_points` gives the first points of a larger one.

    Args:
        depth: `(H, W)` float32, metres; 0 is background.
        camera: The camera of this image.
        num_points: Number of points.
        rng: Source of the draws.

    Raises:
        ValueError: The mask is empty, or the image is not of the camera's size.
    """
    if depth.shape != (camera.height, camera.width):
        raise ValueError(
            f"depth: expected the camera's {camera.height} x {camera.width} (height x width), got {depth.shape}"
        )
    foreground = np.flatnonzero(depth > 0)
    if len(foreground) == 0:
        raise ValueError(
            "depth: the mask is empty, no pixel shows the body; check the segmentation, the depth unit (metres) "
            "and the body's translation"
        )
    order = rng.permutation(len(foreground))
    if len(order) < num_points:
        order = np.concatenate([order, rng.integers(len(order), size=num_points - len(order))])
    chosen = foreground[order[:num_points]]
    v, u = np.divmod(chosen, camera.width)
    pixels = np.stack([u, v], -1)
    points = back_project(
        torch.from_numpy(pixels).float(), torch.from_numpy(depth.reshape(-1)[chosen]), camera.intrinsics()
    )
    return Cloud(points.numpy(), pixels)
