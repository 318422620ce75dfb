"""`task=ar`: a depth camera's recording, frame by frame, to the mesh over the image (thesis, chapter 4)."""

import hashlib
import logging
import os
import time
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from tqdm import tqdm

from ljn.building import build
from ljn.metrics import apve, mpjpe
from ljn.pipeline.motion import WRITERS, PosedFrame, body_motion
from ljn.pipeline.motion_glb import write_glb
from ljn.pipeline.pipeline import Pipeline
from ljn.refinement import chosen_settings
from ljn.render import get_renderer
from ljn.runs.files import path_part, write_json, write_text_atomically
from ljn.runs.packages import DEFAULT, shipped
from ljn.system.overlay import draw_overlay
from ljn.system.recording import Recording
from ljn.system.smoothing import SmoothingSettings
from ljn.system.store import Store
from ljn.system.summary import page, summarise
from ljn.system.system import ArResult, ArSystem
from ljn.system.video import contact_sheet, write_video
from ljn.system.view import WebView
from ljn.tasks.package import chosen_package
from ljn.tasks.validation import check_writable

_LOG = logging.getLogger(__name__)
_FPS = 30.0  # of videos of recordings whose rate nobody knows
_VIDEO, _SHEET, _MOTION, _SUMMARY, _PAGE = (
    "overlay.mp4",
    "overview.jpg",
    "motion",
    "summary.json",
    "index.html",
)
_SHOWN, _COLUMNS = 8, 4  # frames of the overview
_COMMAND = "python run.py task=ar input=RECORDING"


def ar(cfg: DictConfig) -> dict[str, float]:
    """Run the AR system over a recording, into `output_dir/ar/NAME-HASH`.

    A frame that fails is marked, and the others go on. Each frame leaves its arrays (`frames/`) and a picture
    (`pictures/`); all together leave a video, an overview, the motion in AMASS's form, as BVH and as an animated mesh
    (`.glb`), `summary.json` and a page, `index.html`. A call that is cut off leaves these of the frames that it has
    done, and the same call goes on.

    Args:
        cfg: The composed configuration; of it `task`, `recording`, `segmentation`, `ckpt_path`, `weights`, `refine`,
            `body.path`, `paths`, `num_threads` and `trainer.accelerator` count.

    Returns:
        `ar/frames`, `ar/failed`, `ar/frames_per_second`; and where the truth is known `ar/iou` of the silhouettes,
        `ar/mpjpe_mm` and `ar/apve_mm`.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: The recording or a checkpoint is wrong, or no frame could be predicted.
    """
    task = cfg.task
    recording = _recording(cfg)
    if task.true_keypoints and not hasattr(recording, "truth"):
        raise ValueError(
            "task.true_keypoints: expected a recording whose truth is known (recording=synthetic), got "
            f"'{recording.name}'; leave it out"
        )
    smoothing = None
    if task.smooth:
        smoothing = SmoothingSettings(**(OmegaConf.to_container(task.smoothing) or {}))  # type: ignore[arg-type]
    if cfg.num_threads is not None:
        torch.set_num_threads(cfg.num_threads)
    pipeline = _pipeline(cfg, recording)
    segmenter = None if cfg.segmentation is None else build(cfg.segmentation)
    directory = Path(cfg.paths.output_dir) / "ar" / _name(cfg, recording)
    check_writable(directory)
    stages = (pipeline.detector, pipeline.regressor, pipeline.finder.stage if pipeline.finder else None)
    settings = {
        "recording": {"name": recording.name, "camera": asdict(recording.camera), **recording.facts},
        "weights": [stage.origin["hash"] for stage in stages if stage is not None],
        "refine": chosen_settings(cfg.refine),
        "segmentation": OmegaConf.to_container(cfg.segmentation, resolve=True) if cfg.segmentation else None,
        "smoothing": None if smoothing is None else asdict(smoothing),
        "mends_flips": task.mend_flips,
        "true_keypoints": task.true_keypoints,
        "strict": task.strict,
    }
    store = Store(directory, settings)
    system = ArSystem(pipeline, recording.camera, segmenter, smoothing, task.mend_flips)
    try:
        _run(system, recording, store, task)
    finally:
        summary = _finish(store, recording, pipeline, settings)
    if not summary["predicted"]:
        reasons = "; ".join(list(summary["errors"])[:3])
        raise ValueError(f"input: none of {summary['frames']} frames could be predicted: {reasons}")
    metrics: dict[str, float] = {
        name: float(summary[name])
        for name in ("frames", "failed", "iou", "mpjpe_mm", "apve_mm")
        if name in summary
    }
    metrics["frames_per_second"] = summary["frames_per_second"]["all"]
    _LOG.info("%d of %d frames predicted: %s", summary["predicted"], summary["frames"], directory / _PAGE)
    return {f"ar/{name}": value for name, value in metrics.items()}


def _recording(cfg: DictConfig) -> Any:
    given = cfg.task.input
    if (given is None) == (cfg.recording is None):
        got = "neither" if given is None else "both"
        raise ValueError(
            f"input, recording: expected one of them, got {got}; {_COMMAND}, or recording=synthetic, which needs no "
            "file"
        )
    if given is None:
        return build(cfg.recording)
    from ljn.system.readers import open_recording

    return open_recording(given, cfg.task.camera, cfg.task.rgb_camera)


def _pipeline(cfg: DictConfig, recording: Recording) -> Pipeline:
    """The pipeline of the weights that a call names, or of those that ship."""
    task = cfg.task
    if cfg.weights is None and cfg.ckpt_path is None and DEFAULT in shipped():
        cfg.weights = DEFAULT
    package = chosen_package(cfg, "ckpt_path", "task.mesh_ckpt_path")
    if package is None and cfg.ckpt_path is None:
        raise ValueError(
            f"ckpt_path: expected a joint detector's checkpoint, got null; {_COMMAND} weights=NAME"
        )
    use_gpu = cfg.trainer.accelerator != "cpu" and torch.cuda.is_available()
    shared = ("cuda" if use_gpu else "cpu", cfg.body.path, cfg.refine, task.strict, task.keypoint_detector)
    if package:
        return Pipeline.from_pretrained(package, *shared)
    return Pipeline.load(cfg.ckpt_path, task.mesh_ckpt_path, *shared)


def _name(cfg: DictConfig, recording: Recording) -> str:
    """The folder of a recording: one that no other has."""
    if cfg.task.input is None or str(cfg.task.input).startswith("live:"):
        return path_part(recording.name)
    path = Path(cfg.task.input).resolve()
    return f"{path_part(path.name)}-{hashlib.sha256(os.fsencode(path)).hexdigest()[:6]}"


def _run(system: ArSystem, recording: Any, store: Store, task: DictConfig) -> None:
    """Predict and write frame by frame, from the first that is not done."""
    done = store.num_done
    if done:
        _LOG.info("going on after %d frames that are done: %s", done, store.directory)
        system.state = store.read(done - 1).state
    total = recording.num_frames
    if task.max_frames is not None:
        total = task.max_frames if total is None else min(total, task.max_frames)
    if total is not None and done >= total:
        return
    has_truth = hasattr(recording, "truth")
    begin = time.perf_counter()
    with (
        tqdm(total=total, initial=done, unit="frame") as progress,
        WebView(recording.camera, task.port) if task.view else nullcontext() as view,
    ):
        if view is not None:
            progress.write(f"live view: {view.url}")
        for frame in recording.frames(done):
            reading = time.perf_counter() - begin
            truth = recording.truth(frame.number) if has_truth else None
            keypoints = truth.keypoints if truth is not None and task.true_keypoints else None
            result = system(frame, keypoints)
            begin = time.perf_counter()
            picture = draw_overlay(result, recording.camera)
            result.seconds.update({"reading": reading, "overlay": time.perf_counter() - begin})
            about = _about(result, truth, recording)
            if view is not None:
                view.show(result, picture)
            store.write(result, picture, system.state, about)
            progress.update()
            if total is not None and frame.number + 1 >= total:
                break
            begin = time.perf_counter()


def _about(result: ArResult, truth: Any, recording: Recording) -> dict[str, float]:
    """What is to be said of a frame: confidence and, where the truth is known, errors."""
    prediction = result.prediction
    about: dict[str, float] = {}
    if prediction is None:
        return about
    if prediction.confidences is not None:
        about["confidence"] = float(prediction.confidences.mean())
    if truth is None:
        return about
    about["mpjpe_mm"] = float(mpjpe(*(torch.from_numpy(each) for each in (prediction.joints, truth.joints))))
    if prediction.vertices is not None and prediction.faces is not None:
        vertices = (torch.from_numpy(each) for each in (prediction.vertices, truth.vertices))
        about["apve_mm"] = float(apve(*vertices))
        about["iou"] = silhouette_iou(prediction.vertices, prediction.faces, truth.mask, recording)
    return about


def silhouette_iou(vertices: np.ndarray, faces: np.ndarray, mask: np.ndarray, recording: Recording) -> float:
    """Intersection over union of a mesh's silhouette and a mask `(H, W)`."""
    seen = get_renderer("zbuffer")(
        torch.from_numpy(vertices)[None], torch.from_numpy(faces), recording.camera
    )[0].numpy()
    both = (seen > 0) & mask
    return float(both.sum() / max(1, ((seen > 0) | mask).sum()))


def _finish(
    store: Store, recording: Recording, pipeline: Pipeline, settings: dict[str, Any]
) -> dict[str, Any]:
    """Make of the frames that are done what is made of all."""
    frames: list[dict[str, Any]] = []
    posed: list[PosedFrame | None] = []
    for frame in store.stored():
        frames.append({"number": frame.number, "name": frame.name, **frame.about})
        prediction = frame.prediction
        has_mesh = prediction is not None and prediction.pose is not None
        posed.append(PosedFrame.of(prediction) if prediction is not None and has_mesh else None)
    summary = summarise(frames)
    fps = recording.fps or _FPS
    write_video(store.directory / _VIDEO, store.read_pictures(), fps)
    if pictures := list(store.read_pictures(_SHOWN)):
        Image.fromarray(contact_sheet(pictures, _COLUMNS)).save(store.directory / _SHEET, quality=90)
    if pipeline.regressor is not None and any(frame is not None for frame in posed):
        motion = body_motion(posed, pipeline.regressor.module.body, fps)
        for suffix, write in WRITERS.values():
            write(store.directory / f"{_MOTION}{suffix}", motion)
        write_glb(store.directory / f"{_MOTION}.glb", motion, pipeline.regressor.module.body)
    write_json(store.directory / _SUMMARY, {**summary, "settings": settings, "per_frame": frames})
    motions = [f"{_MOTION}{suffix}" for suffix, _ in WRITERS.values()]
    made = [_VIDEO, _SHEET, *motions, f"{_MOTION}.glb", _SUMMARY]
    files = [name for name in made if (store.directory / name).is_file()]
    if frames:
        write_text_atomically(store.directory / _PAGE, page(recording.name, summary, frames, files))
    return summary
