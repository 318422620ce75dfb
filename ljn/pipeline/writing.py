"""Writing a prediction: arrays, and the mesh for viewers."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ljn.geometry.camera import Camera
from ljn.pipeline.prediction import Prediction

_GLTF_FROM_CAMERA = np.array([1.0, -1.0, -1.0])


def write_arrays(path: Path, prediction: Prediction, camera: Camera) -> None:
    """Write a `.npz` with the prediction's arrays under their names, and `camera`: fx, fy, cx, cy, width, height."""
    np.savez_compressed(
        path, **dict[str, Any](prediction.arrays), camera=np.array(list(asdict(camera).values()))
    )


def write_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a mesh as `.ply`, in the camera frame, or as `.glb`, in glTF's axes: y up, z to the camera.

    `vertices` are `(V, 3)`, metres, camera frame; `faces` `(F, 3)`, vertex indices.

    Raises:
        ImportError: trimesh is missing.
    """
    if path.suffix == ".glb":
        vertices = vertices * _GLTF_FROM_CAMERA
    from trimesh import Trimesh  # not for arrays alone

    Trimesh(vertices, faces, process=False).export(path)
