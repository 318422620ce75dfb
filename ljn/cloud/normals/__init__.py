"""Normals of a sampled cloud, pointing towards the camera.

`window` fits a plane in a window of the depth image around each point (fast, from all of the body's pixels). `knn`
fits it to the 30 nearest of the sampled points alone, as the thesis does with Open3D; `open3d` is Open3D itself and
gives the same to within rounding. Which of the two fits it is changes what a network sees, so it is part of a
run's configuration.

The estimators work on one cloud at a time, in NumPy and numba; each is imported when it is first asked for.
"""

from collections.abc import Callable
from importlib import import_module

import numpy as np

from ljn.cloud.sampling import Cloud
from ljn.geometry.camera import Camera
from ljn.optional import import_open3d

NormalEstimator = Callable[[Cloud, np.ndarray, Camera], np.ndarray]
"""`(cloud, noisy depth (H, W), camera) -> (N, 3)` float32 unit normals, camera frame."""

_ESTIMATORS = {
    "window": "ljn.cloud.normals.window:window_normals",
    "knn": "ljn.cloud.normals.neighbours:knn_normals",
    "open3d": "ljn.cloud.normals.neighbours:open3d_normals",
}
NORMALS = tuple(_ESTIMATORS)


def get_normal_estimator(name: str) -> NormalEstimator:
    """The estimator of that name, one of `NORMALS`.

    Raises:
        ValueError: No such estimator.
        ImportError: Open3D is asked for and missing.
    """
    if name not in NORMALS:
        raise ValueError(f"normals: expected one of {', '.join(NORMALS)}, got '{name}'")
    if name == "open3d":
        import_open3d()
    module, _, attribute = _ESTIMATORS[name].partition(":")
    return getattr(import_module(module), attribute)
