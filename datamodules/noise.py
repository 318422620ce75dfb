"""The noise of training data: on depth images, on 2D keypoints and on 3D joints."""

import numpy as np

JOINT_NOISES = ("planar", "isotropic")


def add_depth_noise(
    depth: np.ndarray, noise_std_m: float, rng: np.random.Generator, in_place: bool = False
) -> np.ndarray:
    """A depth image `(H, W)` float32, metres, with Gaussian noise on the body (section 3.6.1); 0 stays 0.

    The draws do not depend on `noise_std_m`, metres. With `in_place`, `depth` itself gets the noise, else a copy.
    """
    noisy = depth if in_place else depth.copy()
    flat = noisy.reshape(-1)
    foreground = np.flatnonzero(flat > 0)
    flat[foreground] += np.float32(noise_std_m) * rng.standard_normal(len(foreground), dtype=np.float32)
    return noisy


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
