"""`task=predict`: joints and meshes of depth images."""

import logging
import sys
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from tqdm import tqdm

from ljn.body.skeleton import JOINT_NAMES
from ljn.geometry.camera import Camera
from ljn.geometry.distance import distances_to_mesh
from ljn.pipeline.depth import body_depth
from ljn.pipeline.inputs import DEPTH_SUFFIXES, read_camera, read_depth, read_keypoints, read_mask
from ljn.pipeline.pictures import draw_prediction
from ljn.pipeline.pipeline import Observation, Pipeline, Prediction
from ljn.pipeline.writing import import_trimesh, write_arrays, write_mesh
from ljn.runs.files import path_part, write_json
from ljn.tasks.validation import check_writable

_LOG = logging.getLogger(__name__)
_BATCH = 8
_COMMAND = (
    "python run.py task=predict input=DEPTH.png camera=CAMERA.yaml keypoints=KEYPOINTS.json ckpt_path=DETECTOR.ckpt "
    "mesh_ckpt_path=MESH.ckpt"
)


class Frame(NamedTuple):
    """The files of one image.

    Attributes:
        name: Names its outputs.
        depth: Depth image.
        keypoints: Keypoints.
        mask: Mask of the person; None for none.
    """

    name: str
    depth: Path
    keypoints: Path
    mask: Path | None


def predict(cfg: DictConfig) -> dict[str, float]:
    """Predict joints and meshes of a depth image, or of each in a folder, into `output_dir/predictions/NAME`.

    A frame of a folder that cannot be predicted is reported and costs the others nothing. `predictions.json` says
    what became of each frame.

    Args:
        cfg: The composed configuration; of it `input`, `camera`, `keypoints`, `mask`, `ckpt_path`, `mesh_ckpt_path`,
            `paths`, `num_threads` and `trainer.accelerator` count.

    Returns:
        `predict/frames`, and with a mesh regressor `predict/median_distance_mm`: the median over the frames of the
        median distance from the cloud's points to the mesh.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: The input or a checkpoint is wrong; or a frame of a folder is, after all others are written.
        ImportError: The package that writes meshes is missing.
    """
    for key in ("input", "camera", "keypoints", "ckpt_path"):
        if cfg[key] is None:
            raise ValueError(f"{key}: expected a path, got null; {_COMMAND}")
    camera = read_camera(cfg.camera)
    frames = find_frames(cfg.input, cfg.keypoints, cfg.mask)
    directory = Path(cfg.paths.output_dir) / "predictions" / path_part(Path(cfg.input).stem)
    check_writable(directory)
    if cfg.mesh_ckpt_path is not None:
        import_trimesh()
    if cfg.num_threads is not None:
        torch.set_num_threads(cfg.num_threads)
    use_gpu = cfg.trainer.accelerator != "cpu" and torch.cuda.is_available()
    pipeline = Pipeline.load(cfg.ckpt_path, cfg.mesh_ckpt_path, "cuda" if use_gpu else "cpu")

    results = _predict_frames(pipeline, frames, camera, directory, may_fail=Path(cfg.input).is_dir())
    failed = [name for name, result in results.items() if "error" in result]
    distances = [
        result["median_distance_mm"] for result in results.values() if "median_distance_mm" in result
    ]
    metrics = {"predict/frames": float(len(results) - len(failed))}
    if distances:
        metrics["predict/median_distance_mm"] = float(np.median(distances))
    summary = {
        **metrics,
        "predict/failed": len(failed),
        "detector": pipeline.detector.origin,
        "regressor": pipeline.regressor.origin if pipeline.regressor else None,
        "camera": asdict(camera),
        "frames": results,
    }
    write_json(directory / "predictions.json", summary)
    _LOG.info("%d of %d frames predicted: %s", len(results) - len(failed), len(results), directory)
    if failed:
        raise ValueError(
            f"input: {len(failed)} of {len(results)} frames failed, all others are written; the first is {failed[0]}: "
            f"{results[failed[0]]['error']} (all of them are in {directory / 'predictions.json'})"
        )
    return metrics


def find_frames(depth: str, keypoints: str, mask: str | None) -> list[Frame]:
    """The frames of a depth image, or of a folder of them with keypoints (and masks) of the same stem in theirs.

    Raises:
        FileNotFoundError: There is no such file or folder, or no depth image in it.
        ValueError: Files and folders are mixed, or two depth images share a stem.
    """
    paths = {"input": Path(depth), "keypoints": Path(keypoints)} | ({"mask": Path(mask)} if mask else {})
    for name, path in paths.items():
        if not path.exists():
            raise FileNotFoundError(f"{name}: no file or folder '{path}'")
    if len({path.is_dir() for path in paths.values()}) > 1:
        kinds = ", ".join(
            f"{name} is a {'folder' if path.is_dir() else 'file'}" for name, path in paths.items()
        )
        raise ValueError(f"input, keypoints, mask: expected files or folders alike, got: {kinds}")
    if not paths["input"].is_dir():
        return [Frame(paths["input"].stem, paths["input"], paths["keypoints"], paths.get("mask"))]
    found = sorted(path for path in paths["input"].iterdir() if path.suffix.lower() in DEPTH_SUFFIXES)
    if not found:
        raise FileNotFoundError(f"input: no depth image ({', '.join(DEPTH_SUFFIXES)}) in '{paths['input']}'")
    for before, path in pairwise(found):
        if before.stem == path.stem:
            raise ValueError(
                f"input: '{before.name}' and '{path.name}' would write the same outputs; rename one"
            )
    return [
        Frame(
            path.stem,
            path,
            paths["keypoints"] / f"{path.stem}.json",
            paths["mask"] / f"{path.stem}.png" if mask else None,
        )
        for path in found
    ]


def _predict_frames(
    pipeline: Pipeline, frames: list[Frame], camera: Camera, directory: Path, may_fail: bool
) -> dict[str, dict[str, Any]]:
    """Predict and write; returns what became of each frame."""
    results: dict[str, dict[str, Any]] = {frame.name: {"input": str(frame.depth)} for frame in frames}
    with tqdm(total=len(frames), unit="frame", disable=None if may_fail else True) as progress:
        for start in range(0, len(frames), _BATCH):
            loaded = []
            for frame in frames[start : start + _BATCH]:
                for suffix in (".npz", ".ply", ".glb", ".png"):
                    # What an earlier call left would pass for this one's.
                    (directory / f"{frame.name}{suffix}").unlink(missing_ok=True)
                try:
                    loaded.append((frame, *_load(pipeline, frame, camera)))
                except (ValueError, FileNotFoundError) as error:
                    if not may_fail:
                        raise
                    results[frame.name]["error"] = str(error)
                    progress.write(f"{frame.name} failed: {error}", file=sys.stderr)
                    progress.update()
            if not loaded:
                continue
            batch = pipeline.predict([observation for _, _, observation in loaded])
            for index, (frame, depth, _) in enumerate(loaded):
                results[frame.name] |= _write(directory / frame.name, batch[index], depth, camera)
                progress.update()
    return results


def _load(pipeline: Pipeline, frame: Frame, camera: Camera) -> tuple[np.ndarray, Observation]:
    """The body's depth `(H, W)`, metres, and what the networks take."""
    mask = None if frame.mask is None else read_mask(frame.mask)
    depth = body_depth(read_depth(frame.depth), camera, mask)
    return depth, pipeline.observe(depth, camera, read_keypoints(frame.keypoints))


def _write(path: Path, prediction: Prediction, depth: np.ndarray, camera: Camera) -> dict[str, Any]:
    """Write a frame's files beside `path`, which has no suffix; returns what the summary says of it."""
    write_arrays(path.with_name(f"{path.name}.npz"), prediction, camera)
    draw_prediction(prediction, depth, camera).savefig(path.with_name(f"{path.name}.png"))
    is_filled = prediction.confidences == 0
    said: dict[str, Any] = {"filled_in": [JOINT_NAMES[joint] for joint in np.flatnonzero(is_filled)]}
    if prediction.vertices is None or prediction.faces is None:
        return said
    for suffix in (".ply", ".glb"):
        write_mesh(path.with_name(f"{path.name}{suffix}"), prediction.vertices, prediction.faces)
    distances = distances_to_mesh(prediction.points[:, :3], prediction.vertices, prediction.faces)
    return said | {"median_distance_mm": 1000 * float(np.median(distances))}
