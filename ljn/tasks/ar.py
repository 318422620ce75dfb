"""`task=ar`: a depth camera's recording, frame by frame, to the mesh over the image (thesis, chapter 4)."""

import hashlib
import logging
import os
import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict
from datetime import datetime
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
from ljn.runs.files import path_part, read_json, write_json, write_text_atomically
from ljn.runs.packages import DEFAULT, shipped
from ljn.system.overlay import draw_overlay
from ljn.system.readers import open_recording
from ljn.system.readers.timestamps import frames_a_second
from ljn.system.recording import Recording
from ljn.system.smoothing import SmoothingSettings
from ljn.system.store import Store
from ljn.system.summary import page, summarise
from ljn.system.system import ArResult, ArSystem
from ljn.system.video import contact_sheet, write_video
from ljn.system.view import WebView
from ljn.tasks.package import chosen_package
from ljn.tasks.running import use_threads
from ljn.tasks.validation import check_writable

_LOG = logging.getLogger(__name__)
_FPS = 30.0  # of videos of recordings whose rate nobody knows
_RESULTS = "ar"
_VIDEO, _SHEET, _SUMMARY, _PAGE = "overlay.mp4", "overview.jpg", "summary.json", "index.html"
_MOTIONS, _GLB = [f"motion{suffix}" for suffix, _ in WRITERS.values()], "motion.glb"
_SHOWN, _COLUMNS = 8, 4  # frames of the overview
_TOLD = 3  # errors that are said at the end
_COMMAND = "python run.py task=ar input=RECORDING"


def ar(cfg: DictConfig) -> dict[str, float]:
    """Run the AR system over a recording, into `output_dir/ar/NAME-HASH`.

    A frame that fails is marked, and the others go on. Each frame leaves its arrays (`frames/`) and a picture
    (`pictures/`); all together leave a video, an overview, the motion in AMASS's form, as BVH and as an animated mesh
    (`.glb`), `summary.json` and a page, `index.html`. A call that is cut off leaves these of the frames that it has
    done, and the same call goes on; once all are done, it says so and does nothing. What a live sensor gives goes into
    a folder of its own each time.

    Args:
        cfg: The composed configuration; of it `task`, `recording`, `segmentation`, `ckpt_path`, `weights`, `refine`,
            `body.path`, `paths`, `num_threads`, `rerun` and `trainer.accelerator` count.

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
    use_threads(cfg)
    pipeline = _pipeline(cfg)
    segmenter = None if cfg.segmentation is None else build(cfg.segmentation)
    directory = Path(cfg.paths.output_dir) / _RESULTS / _name(cfg, recording)
    check_writable(directory)
    stages = (pipeline.detector, pipeline.regressor, pipeline.finder.stage if pipeline.finder else None)
    settings = {
        "recording": _identity(cfg, recording),
        "weights": [stage.origin["hash"] for stage in stages if stage is not None],
        "refine": chosen_settings(cfg.refine),
        "segmentation": OmegaConf.to_container(cfg.segmentation, resolve=True) if cfg.segmentation else None,
        "smoothing": None if smoothing is None else asdict(smoothing),
        "mends_flips": task.mend_flips,
        "true_keypoints": task.true_keypoints,
        "strict": task.strict,
    }
    store = Store(directory, settings, reads=not cfg.rerun)
    summary = _complete(store, _total(recording, task))
    if summary is not None:
        _LOG.info("%s is complete; predict it again with rerun=true", directory)
    else:
        (directory / _SUMMARY).unlink(missing_ok=True)  # until all is made, nothing is complete
        system = ArSystem(pipeline, recording.camera, segmenter, smoothing, task.mend_flips, recording.fps)
        try:
            _run(system, recording, store, task)
        finally:
            summary = _finish(store, recording, pipeline, settings)
    return _told(summary, directory)


def _told(summary: Mapping[str, Any], directory: Path) -> dict[str, float]:
    """A recording's metrics, once its summary is said.

    Raises:
        ValueError: No frame could be predicted.
    """
    if not summary["frames"]:
        raise ValueError(
            f"input: expected frames, got none: {summary['recording'].get('ended', 'it is empty')}"
        )
    most = sorted(summary["errors"].items(), key=lambda each: -each[1])[:_TOLD]
    reasons = "; ".join(f"{count} x {error}" for error, count in most)
    if not summary["predicted"]:
        raise ValueError(
            f"input: none of {summary['frames']} frames could be predicted: {reasons} ({directory / _PAGE})"
        )
    doubted = f", {summary['doubtful']} doubted" if summary["doubtful"] else ""
    _LOG.info(
        "%d of %d frames predicted%s: %s", summary["predicted"], summary["frames"], doubted, directory / _PAGE
    )
    if reasons:
        _LOG.warning("%d frames failed: %s", summary["failed"], reasons)
    metrics: dict[str, float] = {
        name: float(summary[name])
        for name in ("frames", "failed", "iou", "mpjpe_mm", "apve_mm")
        if name in summary
    }
    metrics["frames_per_second"] = summary["frames_per_second"]["all"]
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
    try:
        return open_recording(given, cfg.task.camera, cfg.task.rgb_camera)
    except RuntimeError as error:  # a sensor that cannot be opened
        raise ValueError(str(error)) from error


def _pipeline(cfg: DictConfig) -> Pipeline:
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
    if cfg.task.input is None:
        return path_part(recording.name)
    if str(cfg.task.input).startswith("live:"):  # what is there now does not come again
        return f"{path_part(recording.name)}-{datetime.now():%Y%m%d-%H%M%S}"
    path = Path(cfg.task.input).resolve()
    return f"{path_part(path.name)}-{hashlib.sha256(os.fsencode(path)).hexdigest()[:6]}"


def _identity(cfg: DictConfig, recording: Recording) -> dict[str, Any]:
    """What a recording is: what it is rendered from, or its files, by their names, sizes and times of change."""
    identity: dict[str, Any] = {"name": recording.name, "camera": asdict(recording.camera)}
    if cfg.recording is not None:
        return {**identity, "rendered": OmegaConf.to_container(cfg.recording, resolve=True)}
    given = [cfg.task.input, cfg.task.camera, cfg.task.rgb_camera]
    if cfg.segmentation is not None:
        given.append(cfg.segmentation.get("plate"))
    results, digest = (Path(cfg.paths.output_dir) / _RESULTS).resolve(), hashlib.sha256()
    for root in (Path(each).resolve() for each in given if each is not None):
        for path in [root, *sorted(root.rglob("*"))]:
            if path.is_file() and not path.is_relative_to(results):
                stat = path.stat()
                digest.update(os.fsencode(path) + f" {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return {**identity, "files": digest.hexdigest()[:16]}


def _total(recording: Recording, task: DictConfig) -> int | None:
    """How many frames are asked for; None: as many as come."""
    known = [number for number in (recording.num_frames, task.max_frames) if number is not None]
    return min(known, default=None)


def _complete(store: Store, total: int | None) -> dict[str, Any] | None:
    """The summary of what is complete; None where frames are to be predicted, or files of them to be made."""
    summary = read_json(store.directory / _SUMMARY)
    if not store.num_done or summary is None or summary["frames"] != store.num_done:
        return None
    is_over = "ended" in summary["recording"] or (total is not None and store.num_done >= total)
    has_all = all((store.directory / name).is_file() for name in summary["files"])
    return summary if is_over and has_all else None


def _run(system: ArSystem, recording: Any, store: Store, task: DictConfig) -> None:
    """Predict and write frame by frame, from the first that is not done."""
    done, total = store.num_done, _total(recording, task)
    if total is not None and done >= total:
        return
    if done:
        _LOG.info("going on after %d frames that are done: %s", done, store.directory)
        system.state = store.read(done - 1).state
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
    # What could not be read is among the errors, that of earlier calls, too.
    about = {name: value for name, value in recording.facts.items() if name != "unreadable"}
    summary = {"recording": about, **summarise(frames)}
    # Of a live sensor, as fast as frames were taken from it.
    fps = frames_a_second([frame["timestamp_s"] for frame in frames]) or recording.fps or _FPS
    files = []
    if write_video(store.directory / _VIDEO, store.read_pictures(), fps):
        Image.fromarray(contact_sheet(list(store.read_pictures(_SHOWN)), _COLUMNS)).save(
            store.directory / _SHEET, quality=90
        )
        files = [_VIDEO, _SHEET]
    if pipeline.regressor is not None and any(frame is not None for frame in posed):
        motion = body_motion(posed, pipeline.regressor.module.body, fps)
        for name, (_, write) in zip(_MOTIONS, WRITERS.values()):
            write(store.directory / name, motion)
        write_glb(store.directory / _GLB, motion, pipeline.regressor.module.body)
        files += [*_MOTIONS, _GLB]
    for name in {_VIDEO, _SHEET, *_MOTIONS, _GLB} - set(files):  # of other settings
        (store.directory / name).unlink(missing_ok=True)
    summary["files"] = files
    write_text_atomically(store.directory / _PAGE, page(recording.name, summary, frames, _SUMMARY))
    # The last: with it, all is complete.
    write_json(store.directory / _SUMMARY, {**summary, "settings": settings, "per_frame": frames})
    return summary
