"""Initial 3D joints: 2D keypoints lifted with the depth at their pixels."""

import math

import numba
import numpy as np
import torch

from ljn.geometry.camera import Camera, back_project


def lift_keypoints(keypoints: np.ndarray, depth: np.ndarray, camera: Camera) -> np.ndarray:
    """3D positions of 2D keypoints: their own ray, the depth of the nearest body pixel.

    A keypoint on the body takes the depth of its pixel; one beside it keeps its (u, v) and borrows the depth
    of the nearest body pixel.

    Args:
        keypoints: `(K, 2)`, u and v, pixels; may lie outside the image.
        depth: `(H, W)` float32, metres; 0 is background.
        camera: The camera of this image.

    Returns:
        `(K, 3)` float32, metres, camera frame.

    Raises:
        ValueError: The mask is empty, or a keypoint is not finite.
    """
    borrowed = depth_at(keypoints, depth)
    lifted = back_project(
        torch.from_numpy(np.asarray(keypoints, np.float32)), torch.from_numpy(borrowed), camera.intrinsics()
    )
    return lifted.numpy()


def depth_at(keypoints: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """The depth of the body pixel nearest to each keypoint: `(K,)` float32, metres; see `lift_keypoints`."""
    if not np.isfinite(keypoints).all():
        raise ValueError("keypoints: NaN or infinite values; every keypoint needs a position in pixels")
    borrowed = _nearest_depth(depth, np.ascontiguousarray(keypoints, dtype=np.float64))
    if (borrowed == 0).any():
        raise ValueError("depth: the mask is empty, there is no depth to lift the keypoints with")
    return borrowed


@numba.njit(cache=True, nogil=True)
def _nearest_depth(depth: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Depth of the body pixel nearest to each keypoint; 0 where there is none."""
    height, width = depth.shape
    borrowed = np.zeros(len(keypoints), np.float32)
    for k in range(len(keypoints)):
        u, v = keypoints[k, 0], keypoints[k, 1]
        column, row = round(u), round(v)
        if 0 <= column < width and 0 <= row < height and depth[row, column] > 0:
            borrowed[k] = depth[row, column]
            continue
        best = np.inf
        # Rows outwards from the keypoint, until none can hold a nearer pixel.
        reach = max(abs(v), abs(v - (height - 1)))
        for step in range(int(reach) + 2):
            if step > 1 and (step - 1) ** 2 >= best:
                break
            for side in range(2 if step > 0 else 1):
                row = round(v) + (step if side == 0 else -step)
                if not 0 <= row < height:
                    continue
                room = best - (row - v) ** 2
                if room <= 0:
                    continue
                half = math.sqrt(room) if room < np.inf else float(width + abs(u))
                for column in range(max(int(u - half), 0), min(int(u + half) + 1, width - 1) + 1):
                    distance = (row - v) ** 2 + (column - u) ** 2
                    if distance < best and depth[row, column] > 0:
                        best = distance
                        borrowed[k] = depth[row, column]
    return borrowed
