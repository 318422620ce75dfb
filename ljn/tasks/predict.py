"""`task=predict`: joints and meshes of depth images."""

import hashlib
import logging
import math
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from ljn.body.skeleton import JOINT_NAMES
from ljn.geometry.camera import Camera
from ljn.geometry.distance import distances_to_mesh
from ljn.pipeline.frames import FrameFiles, find_frames, in_order, predict_frames
from ljn.pipeline.inputs import read_camera
from ljn.pipeline.motion import WRITERS, PosedFrame, body_motion, shape_distance_mm
from ljn.pipeline.pictures import draw_prediction
from ljn.pipeline.pipeline import Pipeline
from ljn.pipeline.prediction import Prediction
from ljn.pipeline.report import Report
from ljn.pipeline.writing import write_arrays, write_mesh
from ljn.refinement import chosen_settings
from ljn.runs.files import path_part, write_json
from ljn.runs.packages import DEFAULT, shipped
from ljn.tasks.package import chosen_package
from ljn.tasks.running import use_threads
from ljn.tasks.validation import check_writable

_LOG = logging.getLogger(__name__)
_SUMMARY = "predictions.json"
_SEQUENCE = "sequence"
_WRITTEN = (".npz", ".ply", ".glb", ".png", *(suffix for suffix, _ in WRITERS.values()))
_NEEDED = ("task.input", "task.camera")
_CHECKPOINTS = ("ckpt_path", "task.mesh_ckpt_path")
_OPTIONAL = ("task.keypoints", "task.mask", "task.rgb", "task.keypoint_detector")
_COMMAND = (
    "python run.py task=predict input=DEPTH.png camera=CAMERA.yaml, with checkpoints of your own "
    "ckpt_path=DETECTOR.ckpt mesh_ckpt_path=MESH.ckpt"
)


def predict(cfg: DictConfig) -> dict[str, float]:
    """Predict joints and meshes of a depth image, or of each in a folder, into `output_dir/predictions/NAME-HASH`.

    The hash is that of the input's absolute path, so that `alice/depth` and `bob/depth` have folders of their own; what
    an earlier call on the same input left there is removed. A frame of a folder that cannot be predicted is reported,
    and all others are predicted. `predictions.json` lists each frame's outcome. With `task.sequence`, the frames are
    one motion, too, in files named `sequence`; a frame that failed stays as the one before.

    Args:
        cfg: The composed configuration; of it `task`, `ckpt_path`, `weights`, `refine`, `body.path`, `paths`,
            `num_threads` and `trainer.accelerator` count. With neither checkpoints nor `weights`, the default weights
            are taken, if any ship.

    Returns:
        `predict/frames`, and with a mesh regressor `predict/median_distance_mm`: the median over the frames of the
        median distance from the cloud's points to the mesh.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: The input or a checkpoint is wrong; or a frame of a folder is, after all others are written.
    """
    task = cfg.task
    values = {key: OmegaConf.select(cfg, key) for key in _NEEDED + _OPTIONAL + _CHECKPOINTS}
    if cfg.weights is None and not any(values[key] for key in _CHECKPOINTS) and DEFAULT in shipped():
        cfg.weights = DEFAULT
    package = chosen_package(cfg, *_CHECKPOINTS)
    needed = _NEEDED if package else (*_NEEDED, "ckpt_path")
    for key, value in values.items():
        if not isinstance(value, str) and (key in needed or value is not None):
            got = "null" if value is None else f"{value!r}, no text: write '{key}=\"PATH\"'"
            raise ValueError(f"{key}: expected a path, got {got}; {_COMMAND}")
    camera = read_camera(task.camera)
    frames = find_frames(task.input, task.keypoints, task.mask, task.mask_id, task.rgb)
    forms = _sequence_forms(task)
    if forms:
        frames.sort(key=lambda frame: in_order(frame.name))
        if any(frame.name == _SEQUENCE for frame in frames):
            raise ValueError(
                f"task.sequence: a frame is named '{_SEQUENCE}', as the motion's file will be; rename it"
            )
    directory = _directory(cfg.paths.output_dir, task.input)
    check_writable(directory)
    use_threads(cfg)
    use_gpu = cfg.trainer.accelerator != "cpu" and torch.cuda.is_available()
    device = "cuda" if use_gpu else "cpu"
    if package:
        pipeline = Pipeline.from_pretrained(
            package, device, cfg.body.path, cfg.refine, task.strict, task.keypoint_detector
        )
    else:
        pipeline = Pipeline.load(
            *(cfg.ckpt_path, task.mesh_ckpt_path, device, cfg.body.path, cfg.refine, task.strict),
            task.keypoint_detector,
        )
    if task.keypoints is None and pipeline.needs_keypoints:
        raise ValueError(
            f"task.keypoints: expected a path, since the detector '{package or cfg.ckpt_path}' takes keypoints, got "
            "null; add keypoints=KEYPOINTS.json or keypoint_detector=cpn_depth, or take a detector that can do "
            "without: experiment=detector/cascade"
        )
    if forms and pipeline.regressor is None:
        raise ValueError(
            "task.sequence: a motion is of meshes, and there is no mesh regressor; give task.mesh_ckpt_path=MESH.ckpt"
        )
    if task.keypoints is None and task.rgb is None and pipeline.finder and pipeline.finder.sees == "rgb":
        raise ValueError(
            f"task.rgb: expected a path, since the keypoint detector '{task.keypoint_detector}' finds keypoints in the "
            "colour image, got null; add rgb=IMAGE.png, registered to the depth image"
        )

    results, posed = _predict(pipeline, frames, camera, directory, may_fail=Path(task.input).is_dir())
    failed = [name for name, result in results.items() if "error" in result]
    name = "median_distance_mm"
    metrics = {"predict/frames": float(len(results) - len(failed))}
    if distances := [result[name] for result in results.values() if name in result]:
        metrics[f"predict/{name}"] = float(np.median(distances))
    summary = {
        **metrics,
        "predict/failed": len(failed),
        "predict/doubtful": sum(bool(result.get("warnings")) for result in results.values()),
        "detector": pipeline.detector.origin,
        "regressor": pipeline.regressor.origin if pipeline.regressor else None,
        "keypoint_detector": pipeline.finder.stage.origin if pipeline.finder else None,
        "refine": chosen_settings(cfg.refine),
        "camera": asdict(camera),
        "frames": results,
    }
    if forms and pipeline.regressor is not None and any(frame is not None for frame in posed):
        motion = body_motion(posed, pipeline.regressor.module.body, task.rate_hz)
        for form in forms:
            suffix, write = WRITERS[form]
            write(directory / f"{_SEQUENCE}{suffix}", motion)
        summary[_SEQUENCE] = {
            "rate_hz": task.rate_hz,
            "frames": len(posed),
            "betas": motion.betas.tolist(),
            "shape_distance_mm": shape_distance_mm(posed, motion),
        }
    write_json(directory / _SUMMARY, summary)
    _LOG.info("%d of %d frames predicted: %s", len(results) - len(failed), len(results), directory)
    if failed:
        raise ValueError(
            f"task.input: {len(failed)} of {len(results)} frames failed, all others are written; the first is "
            f"{failed[0]}: {results[failed[0]]['error']} (all of them are in {directory / _SUMMARY})"
        )
    return metrics


def _sequence_forms(task: Any) -> list[str]:
    """The forms of the sequence's files; raises a `ValueError` where what is asked for makes no sense."""
    given = OmegaConf.to_container(task)["sequence"]  # type: ignore[index, call-overload]
    forms = [given] if isinstance(given, str) else given or []
    if unknown := [form for form in forms if form not in WRITERS]:
        raise ValueError(f"task.sequence: expected some of {', '.join(WRITERS)}, got {unknown[0]!r}")
    if forms and not Path(task.input).is_dir():
        raise ValueError(
            f"task.sequence: expected a folder of frames as task.input, got the file '{task.input}'"
        )
    if not (isinstance(task.rate_hz, int | float) and 0 < task.rate_hz < math.inf):
        raise ValueError(f"task.rate_hz: expected frames a second, more than 0, got {task.rate_hz!r}")
    return forms


def _directory(output_dir: str, input: str) -> Path:
    """Where the predictions of an input go: a folder that no other input has."""
    path = Path(input).resolve()
    name = path.name if path.is_dir() else path.stem
    digest = hashlib.sha256(os.fsencode(path)).hexdigest()[:6]
    return Path(output_dir) / "predictions" / f"{path_part(name)}-{digest}"


def _predict(
    pipeline: Pipeline, frames: list[FrameFiles], camera: Camera, directory: Path, may_fail: bool
) -> tuple[dict[str, dict[str, Any]], list[PosedFrame | None]]:
    """Predict and write; returns what became of each frame, and its pose, None where there is none."""
    for path in directory.glob("*"):
        if path.suffix in _WRITTEN or path.name == _SUMMARY:
            path.unlink()  # of an earlier call; it would pass for this one's
    results: dict[str, dict[str, Any]] = {}
    posed: list[PosedFrame | None] = []
    with tqdm(total=len(frames), unit="frame", disable=None if may_fail else True) as progress:
        for frame, prediction, depth, error in predict_frames(pipeline, frames, camera, FrameFiles.read):
            results[frame.name] = {"input": str(frame.depth)}
            if prediction is None or prediction.pose is None:
                posed.append(None)
            else:
                posed.append(PosedFrame.of(prediction))
            if prediction is not None and depth is not None:
                results[frame.name] |= _write(directory / frame.name, prediction, depth, camera)
            elif error is not None:
                if not may_fail:
                    raise error
                results[frame.name]["error"] = str(error)
                progress.write(f"{frame.name} failed: {error}", file=sys.stderr)
            progress.update()
    return results, posed


def _write(path: Path, prediction: Prediction, depth: np.ndarray, camera: Camera) -> dict[str, Any]:
    """Write a frame's files beside `path`, which has no suffix; returns the summary's facts of it."""
    write_arrays(path.with_name(f"{path.name}.npz"), prediction, camera)
    draw_prediction(prediction, depth, camera).savefig(path.with_name(f"{path.name}.png"))
    facts: dict[str, Any] = {}
    if isinstance(prediction.report, Report):
        facts |= {**prediction.report.facts, "warnings": prediction.report.warnings}
    if prediction.confidences is not None:
        is_filled = prediction.confidences == 0
        facts["filled_in"] = [JOINT_NAMES[joint] for joint in np.flatnonzero(is_filled)]
    if prediction.vertices is None or prediction.faces is None:
        return facts
    for suffix in (".ply", ".glb"):
        write_mesh(path.with_name(f"{path.name}{suffix}"), prediction.vertices, prediction.faces)
    if prediction.is_refined is not None and prediction.residual_mm is not None:
        facts |= {"is_refined": bool(prediction.is_refined), "residual_mm": prediction.residual_mm.tolist()}
    distances = distances_to_mesh(prediction.points[:, :3], prediction.vertices, prediction.faces)
    return facts | {"median_distance_mm": 1000 * float(np.median(distances))}
