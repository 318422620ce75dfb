"""Depth images whose truth is known, as files that a user could have made: written, and read again."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import yaml
from PIL import Image

from ljn.body import SMPL, load_body_models
from ljn.body.skeleton import NUM_JOINTS, ROOT
from ljn.geometry.camera import Camera, place_at_root
from ljn.pipeline.frames import FrameFiles, find_frames
from ljn.pipeline.inputs import read_camera
from ljn.pipeline.prediction import Prediction
from ljn.reading import READ_ERRORS, read_arrays, reason

CAMERA, DEPTH, KEYPOINTS, TRUTH = "camera.yaml", "depth", "keypoints", "truth"
"""In a folder of samples: the camera's file, and the folders of depth images, keypoints and truths."""
_MM_PER_METRE = 1000
_SHAPES = {"joints": (NUM_JOINTS, 3), "pose": (3 * NUM_JOINTS,), "betas": (10,), "gender": (), "body": ()}


class Truth(NamedTuple):
    """What is known of the person in a depth image.

    Attributes:
        joints: `(24, 3)`, metres, camera frame.
        pose: `(72,)` axis-angle, radians; see `Batch`.
        betas: `(10,)`.
        gender: Of the body.
        body: The body's hash.
    """

    joints: np.ndarray
    pose: np.ndarray
    betas: np.ndarray
    gender: str
    body: str

    def vertices(self, body_path: str | Path | None = None) -> np.ndarray:
        """The true mesh `(V, 3)`, metres, camera frame.

        Args:
            body_path: Where the body is found; see `load_body_models`.

        Raises:
            ValueError: The body there is another one.
        """
        body = SMPL(load_body_models(body_path, [self.gender])).double()
        if body.hash != self.body:
            raise ValueError(
                f"body: the truth belongs to the {self.gender} body {self.body}, but the one found here is "
                f"{body.hash}; export the samples again, or name their bodies with body.path=FILE_OR_FOLDER"
            )
        posed = body(*(torch.from_numpy(values).double()[None] for values in (self.pose, self.betas)))
        root = torch.from_numpy(self.joints[ROOT]).double()
        return place_at_root(posed.vertices[0], posed.joints[0, ROOT], root).numpy()


def pseudo_label(prediction: Prediction, body: SMPL, max_residual_mm: float = 5.0) -> Truth | None:
    """What a refined prediction says of a real image of which nothing is known, where it can be relied on.

    For training on unlabelled depth, or to check labels; `write_sample` writes it with its image.

    Args:
        prediction: Of one image, by a pipeline that refines.
        body: The body that it is a mesh of: the regressor's.
        max_residual_mm: The largest median distance of the cloud to the mesh.

    Returns:
        None where the fit was given up, or leaves more.

    Raises:
        ValueError: The prediction is not refined, or is a batch.
    """
    values = (
        prediction.is_refined,
        prediction.residual_mm,
        prediction.mesh_joints,
        prediction.pose,
        prediction.betas,
    )
    is_refined, residual_mm, joints, pose, betas = values
    if is_refined is None or residual_mm is None or joints is None or pose is None or betas is None:
        raise ValueError(
            "prediction: expected one of a pipeline that refines, Pipeline.load(..., refine=True)"
        )
    if joints.ndim != 2:
        raise ValueError(
            f"prediction: expected that of one image, got a batch of {len(joints)}; take them one by one"
        )
    if not is_refined or residual_mm[1] > max_residual_mm:
        return None
    return Truth(joints, pose, betas, body.genders[0], body.hash)


class SampleFiles(NamedTuple):
    """One folder of samples, all of one camera.

    Attributes:
        name: The folder's.
        camera: The camera.
        frames: The images' files, by name.
        truths: Of each, the file of its truth.
    """

    name: str
    camera: Camera
    frames: list[FrameFiles]
    truths: list[Path]


def write_camera(directory: Path, camera: Camera) -> None:
    """Write the camera of a folder of samples as `read_camera` reads it."""
    text = "# Pixels; pixel centres are at integer coordinates.\n"
    (directory / CAMERA).write_text(text + yaml.safe_dump(vars(camera), sort_keys=False), encoding="utf-8")


def write_sample(
    directory: Path, name: str, depth: np.ndarray, keypoints: Sequence[Sequence[float]], truth: Truth
) -> None:
    """Write a sample's files into a folder of samples.

    Args:
        directory: The folder.
        name: The files' stem.
        depth: `(H, W)`, metres; 0 is background.
        keypoints: 24 of [u, v] or [u, v, confidence], pixels.
        truth: What is known.
    """
    for folder in (DEPTH, KEYPOINTS, TRUTH):
        (directory / folder).mkdir(parents=True, exist_ok=True)
    millimetres = np.round(_MM_PER_METRE * depth).astype(np.uint16)
    Image.fromarray(millimetres).save(directory / DEPTH / f"{name}.png", optimize=True)
    rows = ",\n ".join(json.dumps([round(float(value), 2) for value in row]) for row in keypoints)
    (directory / KEYPOINTS / f"{name}.json").write_text(f"[{rows}]\n", encoding="utf-8")
    np.savez_compressed(directory / TRUTH / f"{name}.npz", **truth._asdict())


def find_samples(directory: str | Path) -> list[SampleFiles]:
    """The samples in a folder that `task=export` wrote, or in each of the folders of such a folder of folders.

    Raises:
        FileNotFoundError: There is none.
        ValueError: A camera cannot be read, or two frames have the same name.
    """
    directory = Path(directory)
    folders = [directory] if (directory / CAMERA).is_file() else sorted(directory.glob(f"*/{CAMERA}"))
    folders = [path if path.is_dir() else path.parent for path in folders]
    if not folders:
        raise FileNotFoundError(
            f"directory: no {CAMERA} in '{directory}' or in a folder of it; python run.py task=export writes samples"
        )
    samples = []
    for folder in folders:
        frames = find_frames(folder / DEPTH, folder / KEYPOINTS)
        truths = [folder / TRUTH / f"{frame.name}.npz" for frame in frames]
        samples.append(SampleFiles(folder.name, read_camera(folder / CAMERA), frames, truths))
    names = [frame.name for files in samples for frame in files.frames]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"directory: two frames in '{directory}' are called '{twice[0]}'; rename one")
    return samples


def read_truth(path: str | Path) -> Truth:
    """What is known of the person in a sample's image.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or holds something else.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"truth: no file '{path}'; python run.py task=export writes one for each sample"
        )
    try:
        arrays = read_arrays(path)
    except READ_ERRORS as error:
        raise ValueError(f"truth: '{path}' is damaged ({reason(error)}); export the samples again") from error
    shapes = {name: value.shape for name, value in arrays.items()}
    if shapes != _SHAPES:
        raise ValueError(f"truth: expected the arrays {_SHAPES} in '{path}', got {shapes}")
    gender, body = (str(arrays[name]) for name in ("gender", "body"))
    return Truth(arrays["joints"], arrays["pose"], arrays["betas"], gender, body)
