"""The noise of training data: on depth images, on 2D keypoints and on 3D joints."""

import numba
import numpy as np

JOINT_NOISES = ("planar", "isotropic")


def add_depth_noise(
    depth: np.ndarray, noise_std_m: float, rng: np.random.Generator, in_place: bool = False
) -> np.ndarray:
    """A depth image `(H, W)` float32, metres, with Gaussian noise on the body (section 3.6.1); 0 stays 0.

    The draws do not depend on `noise_std_m`, metres. With `in_place`, `depth` itself gets the noise, else a copy.
    """
    noisy = depth if in_place else depth.copy()
    noise = rng.standard_normal(_num_foreground(noisy), dtype=np.float32)
    noise *= np.float32(noise_std_m)
    _add_to_foreground(noisy, noise)
    return noisy


@numba.njit(cache=True, nogil=True)
def _num_foreground(depth: np.ndarray) -> int:
    """How many pixels of `(H, W)` show the body."""
    number = 0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            number += depth[v, u] > 0.0
    return number


@numba.njit(cache=True, nogil=True)
def _add_to_foreground(depth: np.ndarray, noise: np.ndarray) -> None:
    """Add to each pixel of `(H, W)` that shows the body the next number of `noise`, row by row."""
    k = 0
    for v in range(depth.shape[0]):
        is_empty = True
        for u in range(depth.shape[1]):  # without a jump, some pixels at once
            is_empty &= depth[v, u] <= 0.0
        if is_empty:
            continue
        for u in range(depth.shape[1]):
            if depth[v, u] > 0.0:
                depth[v, u] += noise[k]
                k += 1


def add_keypoint_noise(keypoints: np.ndarray, noise_px: float, rng: np.random.Generator) -> np.ndarray:
    """2D keypoints `(K, 2)` as a detector might give them, float32, pixels; they may lie outside the image.

    The draws do not depend on `noise_px`, the standard deviation of the Gaussian noise on u and on v, pixels.
    """
    return (keypoints + noise_px * rng.standard_normal(keypoints.shape)).astype(np.float32)


def add_joint_noise(joints: np.ndarray, noise_m: float, kind: str, rng: np.random.Generator) -> np.ndarray:
    """Joints as a joint detector might give them (section 3.6.3).

    Args:
        joints: `(K, 3)`, metres, camera frame.
        noise_m: Standard deviation of the Gaussian noise along each direction, metres.
        kind: `planar` (x and y, whose mean distance sigma * sqrt(pi / 2) is that of Table 3.6) or `isotropic`.
        rng: Source of the draws; they depend on neither `noise_m` nor `kind`.

    Returns:
        `(K, 3)` float32.
    """
    noise = rng.standard_normal(joints.shape)
    if kind == "planar":
        noise[:, 2] = 0
    return (joints + noise_m * noise).astype(np.float32)
